//! Files that are there whole or not at all.

use anyhow::Context;
use std::fs::{File, Permissions};
use std::io::{Read, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// How the names of temporary files begin.
const UNFINISHED: &str = ".unfinished-";
/// Name of the file in a folder that the process that keeps it has locked.
const LOCK: &str = ".lock";

/// Makes a folder, if there is none, and takes it over for as long as the answer lives: two processes would each know a
/// part of what is in it.
///
/// # Errors
/// If the folder cannot be made, or another process has it.
pub fn take_over(folder: &Path) -> anyhow::Result<File> {
    std::fs::create_dir_all(folder).with_context(|| folder.display().to_string())?;
    let lock = File::create(folder.join(LOCK)).with_context(|| folder.display().to_string())?;
    lock.try_lock().with_context(|| format!("{}: expected a folder that no process keeps", folder.display()))?;
    Ok(lock)
}

/// A regular file's bytes, from the beginning and so many at most.
///
/// # Errors
/// If it cannot be read, or is no regular file: reading from one that is not may never end.
pub fn read_at_most(path: &Path, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    if !path.metadata()?.is_file() {
        return Err(std::io::Error::other("not a regular file"));
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(max_bytes as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Writes a file by way of a temporary one beside it, so that no reader ever sees a part. When this returns, the file
/// outlasts a crash.
///
/// # Errors
/// If the folder cannot be made or written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write(path, bytes, 0o666)
}

/// The same for what nobody else may read.
///
/// # Errors
/// If the folder cannot be made or written.
pub fn write_secret(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write(path, bytes, 0o600)
}

fn write(path: &Path, bytes: &[u8], mode: u32) -> anyhow::Result<()> {
    let write = || {
        let folder = path.parent().context("a path without a folder")?;
        if !folder.exists() {
            std::fs::create_dir_all(folder)?;
            sync(folder.parent().unwrap_or(folder))?;
        }
        // Temporary files are private by default; the umask decides what becomes of the mode.
        let permissions = Permissions::from_mode(mode);
        let mut file = tempfile::Builder::new().prefix(UNFINISHED).permissions(permissions).tempfile_in(folder)?;
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
