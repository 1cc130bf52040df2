//! Results on standard output.

use anyhow::anyhow;
use std::fmt::Display;
use std::io::{ErrorKind, Write};

/// Writes a text to standard output. That nobody reads it any more is no error.
///
/// # Errors
/// If it cannot be written, with the name of the file.
pub fn print(text: impl Display) -> anyhow::Result<()> {
    let write = || {
        let mut out = std::io::stdout().lock();
        write!(out, "{text}")?;
        out.flush()
    };
    accept(write())
}

/// The same, and the end of the line.
///
/// # Errors
/// As [`print`].
pub fn print_line(text: impl Display) -> anyhow::Result<()> {
    print(format_args!("{text}\n"))
}

/// What is to be told of a try to write to standard output: nothing if nobody reads it.
///
/// # Errors
/// Why it cannot be written, with the name of the file.
pub fn accept(written: std::io::Result<()>) -> anyhow::Result<()> {
    match written {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            let name = std::fs::read_link("/proc/self/fd/1").unwrap_or_default();
            Err(anyhow!(error).context(format!("standard output {}", name.display())))
        }
        _ => Ok(()),
    }
}
