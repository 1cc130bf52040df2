//! Files that are there whole or not at all.

use anyhow::Context;
use std::fs::{File, Permissions};
use std::io::Write;
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// How the names of temporary files begin.
const UNFINISHED: &str = ".unfinished-";

/// Writes a file by way of a temporary one beside it, so that no reader ever sees a part. When this returns, the file
/// outlasts a crash.
///
/// # Errors
/// If the folder cannot be made or written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let write = || {
        let folder = path.parent().context("a path without a folder")?;
        if !folder.exists() {
            std::fs::create_dir_all(folder)?;
            sync(folder.parent().unwrap_or(folder))?;
        }
        // Temporary files are private by default; this one becomes an ordinary file, as the umask would have it.
        let ordinary = Permissions::from_mode(0o666);
        let mut file = tempfile::Builder::new().prefix(UNFINISHED).permissions(ordinary).tempfile_in(folder)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        sync(folder)
    };
    write().with_context(|| format!("writing {}", path.display()))
}

/// Makes the names in a folder last.
fn sync(folder: &Path) -> anyhow::Result<()> {
    // `.` stands for an empty path.
    Ok(File::open(Path::new(".").join(folder))?.sync_all()?)
}

/// Removes what killed processes left in a folder, which nobody else may be writing to.
///
/// # Errors
/// If the folder cannot be read or written.
pub fn remove_unfinished(folder: &Path) -> anyhow::Result<()> {
    let remove = || {
        for entry in std::fs::read_dir(folder)? {
            let entry = entry?;
            if entry.file_name().to_string_lossy().starts_with(UNFINISHED) {
                std::fs::remove_file(entry.path())?;
            }
        }
        anyhow::Ok(())
    };
    remove().with_context(|| folder.display().to_string())
}
