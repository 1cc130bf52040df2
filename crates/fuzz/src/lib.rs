//! Common parts of the decoders' fuzzers, which are programs in `src/bin`; `make fuzz` runs them.

use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt::Debug;
use std::fs;
use std::path::Path;
use std::ptr;

/// Maximum size of an allocation, in bytes: twice that of the largest message, checkpoint or recording.
const MAX_ALLOCATION_BYTES: usize = 128 << 20;

/// The system's allocator, with failing allocations above [`MAX_ALLOCATION_BYTES`], which only a faulty decoder requests.
struct Bounded;

#[global_allocator]
static ALLOCATOR: Bounded = Bounded;

// SAFETY: all successful calls are forwarded to the system's allocator, with the same arguments.
#[expect(unsafe_code, reason = "an allocator")]
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if layout.size() > MAX_ALLOCATION_BYTES { ptr::null_mut() } else { unsafe { System.alloc(layout) } }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        unsafe { System.dealloc(memory, layout) }
    }
}

/// Writes the seed inputs of a fuzzer to its corpus.
///
/// # Panics
/// If a file cannot be written, or `check` refuses an input, which would then be no better a seed than random bytes.
pub fn seed<E: Debug>(fuzzer: &str, inputs: Vec<Vec<u8>>, check: fn(&[u8]) -> Result<(), E>) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(fuzzer);
    fs::create_dir_all(&folder).expect("a folder for the corpus");
    for (number, input) in inputs.iter().enumerate() {
        check(input).unwrap_or_else(|refusal| panic!("input {number} of {fuzzer}: {refusal:?}"));
        fs::write(folder.join(format!("seed-{number}")), input).expect("room for the corpus");
    }
}
