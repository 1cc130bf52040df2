//! Settings of glibc's allocator for training.

use std::os::unix::process::CommandExt;
use std::process::Command;
use std::{env, io};

/// Environment variables that keep freed large blocks in the process for the next step. Otherwise they return to the kernel, which
/// clears them again: about a sixth of a step's time.
const KEEP: [(&str, &str); 2] = [("MALLOC_MMAP_THRESHOLD_", "4000000000"), ("MALLOC_TRIM_THRESHOLD_", "4000000000")];

/// Makes glibc keep freed memory. Unless its settings are in the environment already, the process is replaced by itself with them,
/// since glibc reads them only at the start of a process.
///
/// # Errors
/// If the program cannot be executed again.
pub fn keep() -> io::Result<()> {
    if KEEP.iter().all(|(name, _)| env::var_os(name).is_some()) {
        return Ok(());
    }
    Err(Command::new(env::current_exe()?).args(env::args_os().skip(1)).envs(KEEP).exec())
}
