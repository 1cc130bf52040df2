//! Results on standard output.

use anyhow::anyhow;
use std::fmt::Display;
use std::io::{ErrorKind, Write};

/// Writes a text to standard output. A closed pipe is no error.
///
/// # Errors
/// If standard output cannot be written, with the name of its file.
pub fn print(text: impl Display) -> anyhow::Result<()> {
    let write = || {
        let mut out = std::io::stdout().lock();
        write!(out, "{text}")?;
        out.flush()
    };
    accept(write())
}

/// Writes a text and a line break to standard output.
///
/// # Errors
/// As [`print`].
pub fn print_line(text: impl Display) -> anyhow::Result<()> {
    print(format_args!("{text}\n"))
}

/// Converts the result of a write to standard output: a closed pipe is no error.
///
/// # Errors
/// If the write failed otherwise, with the name of standard output's file.
pub fn accept(written: std::io::Result<()>) -> anyhow::Result<()> {
    match written {
        Err(error) if error.kind() != ErrorKind::BrokenPipe => {
            let name = std::fs::read_link("/proc/self/fd/1").unwrap_or_default();
            Err(anyhow!(error).context(format!("standard output {}", name.display())))
        }
        _ => Ok(()),
    }
}
