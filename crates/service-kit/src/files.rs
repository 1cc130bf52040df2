//! Files that are there whole or not at all.

use anyhow::Context;
use std::fs::Permissions;
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Writes a file by way of a temporary one beside it, so that no reader ever sees a part.
///
/// # Errors
/// If the folder cannot be made or written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || {
        let folder = path.parent().context("a path without a folder")?;
        std::fs::create_dir_all(folder)?;
        // Temporary files are private by default; this one becomes an ordinary file, as the umask would have it.
        let ordinary = Permissions::from_mode(0o666);
        let mut file = tempfile::Builder::new().permissions(ordinary).tempfile_in(folder)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        anyhow::Ok(())
    };
    write().with_context(|| format!("writing {}", path.display()))
}
