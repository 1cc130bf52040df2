//! Files that are there whole or not at all.

use anyhow::Context;
use std::io::Write;
use std::path::Path;

/// Writes a file by way of a temporary one beside it, so that no reader ever sees a part.
///
/// # Errors
/// If the folder cannot be made or written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || {
        let folder = path.parent().context("a path without a folder")?;
        std::fs::create_dir_all(folder)?;
        let mut file = tempfile::NamedTempFile::new_in(folder)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        anyhow::Ok(())
    };
    write().with_context(|| format!("writing {}", path.display()))
}
