//! What the fuzzers of the decoders share. Each is a program in `src/bin`; `make fuzz` runs them.

use std::alloc::{GlobalAlloc, Layout, System};
use std::fmt::Debug;
use std::fs;
use std::path::Path;
use std::ptr;

/// Most bytes that a decoder may ask for at once: twice the largest message, checkpoint or recording.
const MAX_ALLOCATION_BYTES: usize = 128 << 20;

/// The system's memory, but for pieces so large that only a fault asks for them.
struct Bounded;

#[global_allocator]
static ALLOCATOR: Bounded = Bounded;

// SAFETY: whatever is allocated is the system allocator's, by the same arguments.
#[expect(unsafe_code, reason = "an allocator")]
unsafe impl GlobalAlloc for Bounded {
    unsafe fn alloc(&self, layout: Layout) -> *mut u8 {
        if layout.size() > MAX_ALLOCATION_BYTES { ptr::null_mut() } else { unsafe { System.alloc(layout) } }
    }

    unsafe fn dealloc(&self, memory: *mut u8, layout: Layout) {
        unsafe { System.dealloc(memory, layout) }
    }
}

/// Lays inputs into the corpus of a fuzzer, to begin with.
///
/// # Panics
/// If they cannot be written, or one of them is refused: it would lead the fuzzer no further than noise.
pub fn seed<E: Debug>(fuzzer: &str, inputs: Vec<Vec<u8>>, check: fn(&[u8]) -> Result<(), E>) {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("corpus").join(fuzzer);
    fs::create_dir_all(&folder).expect("a folder for the corpus");
    for (number, input) in inputs.iter().enumerate() {
        check(input).unwrap_or_else(|refusal| panic!("input {number} of {fuzzer}: {refusal:?}"));
        fs::write(folder.join(format!("seed-{number}")), input).expect("room for the corpus");
    }
}
