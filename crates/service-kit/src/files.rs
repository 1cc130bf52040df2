//! Atomic writes, bounded reads, and locks of files and folders.

use anyhow::{Context, bail};
use std::ffi::OsStr;
use std::fs::{File, Permissions};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Prefix of the names of temporary files.
const UNFINISHED: &str = ".unfinished-";
/// Name of a folder's lock file.
const LOCK: &str = ".lock";
/// Longest description of a lock's holder, in bytes.
const MAX_HOLDER_BYTES: u64 = 1024;
/// Folder for recovered files at the root of a file system.
const LOST_AND_FOUND: &str = "lost+found";

/// Creates a folder, if there is none, and locks it for as long as the returned file lives: with two writers, each would know
/// only a part of its contents.
///
/// # Errors
/// If the folder cannot be created, or another process holds the lock, which the error names.
pub fn take_over(folder: &Path) -> anyhow::Result<File> {
    lock(folder, LOCK).with_context(|| folder.display().to_string())
}

/// Locks a single file, and the files that this process writes beside it; other files of its folder stay free.
///
/// # Errors
/// If its folder cannot be created, or another process holds the lock, which the error names.
pub fn take_over_file(path: &Path) -> anyhow::Result<File> {
    let take_over = || {
        let name = path.file_name().context("expected the path of a file")?;
        lock(path.parent().unwrap_or(path), &format!(".{}{LOCK}", name.to_string_lossy()))
    };
    take_over().with_context(|| path.display().to_string())
}

/// Locks the file `name` of a folder, and writes a description of this process into it.
fn lock(folder: &Path, name: &str) -> anyhow::Result<File> {
    std::fs::create_dir_all(folder)?;
    let path = folder.join(name);
    // Not truncated: the file has the description of the current holder.
    let mut lock = File::options().read(true).write(true).create(true).truncate(false).open(&path)?;
    if let Err(error) = lock.try_lock() {
        let std::fs::TryLockError::WouldBlock = error else { return Err(error.into()) };
        let mut holder = String::new();
        // The holder may not have written its description yet.
        let _ = lock.take(MAX_HOLDER_BYTES).read_to_string(&mut holder);
        let holder = if holder.is_empty() { "another process" } else { holder.trim() };
        bail!("expected one that no process keeps, got that of {holder}");
    }

    // The lock holds without the description, which only serves error messages.
    let _ = lock.set_len(0).and_then(|()| lock.write_all(this_process().as_bytes()));
    Ok(lock)
}

/// Description of this process, for people: number, program and host.
fn this_process() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let program = std::env::args().next().unwrap_or_default();
    let program = Path::new(&program).file_name().unwrap_or_default().to_string_lossy();
    format!("process {} ({program}) on {}\n", std::process::id(), host.trim())
}

/// Paths in a folder, ordered by name, without `lost+found` and names that begin with a dot, which operating systems, editors
/// and unfinished writes leave behind.
///
/// # Errors
/// If the folder does not exist or cannot be read.
pub fn list(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let list = || {
        let paths = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        std::io::Result::Ok(paths)
    };
    let mut paths = list().with_context(|| format!("folder {}", folder.display()))?;
    paths.retain(|path| path.file_name().is_some_and(|name| !is_hidden(name)));
    paths.sort();
    Ok(paths)
}

fn is_hidden(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".") || name == LOST_AND_FOUND
}

/// Reads the first `max_bytes` of a regular file, or all if there are fewer.
///
/// # Errors
/// If it cannot be read, or is no regular file: reading from a device or pipe may never end.
pub fn read_at_most(path: &Path, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    if !path.metadata()?.is_file() {
        return Err(std::io::Error::other("not a regular file"));
    }
    let mut bytes = Vec::new();
    File::open(path)?.take(max_bytes as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Reads a regular file of at most `max_bytes`.
///
/// # Errors
/// If it cannot be read, is no regular file, or is larger than `max_bytes`.
pub fn read_all(path: &Path, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    let bytes = read_at_most(path, max_bytes + 1)?;
    if bytes.len() > max_bytes {
        return Err(std::io::Error::other(format!("expected at most {max_bytes} bytes, got more")));
    }
    Ok(bytes)
}

/// Reads the first `max_bytes` of the file `name` inside a folder; symbolic links that lead out of it are refused.
///
/// # Errors
/// If it cannot be read, is no regular file, or is outside the folder.
pub fn read_inside(folder: &Path, name: &str, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    let other = std::io::Error::other;
    let path = folder.join(name).canonicalize()?;
    if !path.starts_with(folder.canonicalize()?) {
        return Err(other("a link to a file outside the folder"));
    }

    // The opened file must be the checked one: it may be replaced in between.
    let found = path.symlink_metadata()?;
    if !found.is_file() {
        return Err(other("not a regular file"));
    }
    let file = File::open(&path)?;
    let opened = file.metadata()?;
    if (found.dev(), found.ino()) != (opened.dev(), opened.ino()) {
        return Err(other("another file by now"));
    }

    let mut bytes = Vec::new();
    file.take(max_bytes as u64).read_to_end(&mut bytes)?;
    Ok(bytes)
}

/// Writes a file atomically, by way of a temporary one beside it. When this returns, the file is durable.
///
/// # Errors
/// If the folder cannot be created or written.
pub fn write_atomically(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    write(path, bytes, 0o666)
}

/// Writes a file atomically that only this user may read.
///
/// # Errors
/// If the folder cannot be created or written.
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
        // Temporary files are private by default; the umask applies to this mode.
        let permissions = Permissions::from_mode(mode);
        let mut file = tempfile::Builder::new().prefix(UNFINISHED).permissions(permissions).tempfile_in(folder)?;
        file.write_all(bytes)?;
        file.as_file().sync_all()?;
        file.persist(path)?;
        sync(folder)
    };
    write().with_context(|| format!("writing {}", path.display()))
}

/// Makes the entries of a folder durable.
fn sync(folder: &Path) -> anyhow::Result<()> {
    // An empty path is the current folder.
    Ok(File::open(Path::new(".").join(folder))?.sync_all()?)
}

/// Removes the temporary files that killed processes left in a folder; no other process may be writing to it.
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

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;

    #[test]
    fn a_locked_folder_or_file_is_refused_with_its_holder() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a/model.safetensors");
        for take_over in [|path: &Path| take_over(path), |path: &Path| take_over_file(path)] {
            let kept = take_over(&file).unwrap();
            let error = format!("{:#}", take_over(&file).unwrap_err());
            let expected = format!("{}: expected one that no process keeps, got that of process ", file.display());
            assert!(error.starts_with(&format!("{expected}{} (", std::process::id())), "{error}");
            drop(kept);
            take_over(&file).unwrap();
        }
    }

    #[test]
    fn hidden_names_are_not_listed_and_a_missing_folder_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        for name in ["b", "._b", ".Trash-1000", "lost+found", "a.b", "c"] {
            std::fs::create_dir(folder.path().join(name)).unwrap();
        }
        let names = ["a.b", "b", "c"].map(|name| folder.path().join(name));
        assert_eq!(list(folder.path()).unwrap(), names);
        let absent = folder.path().join("absent");
        let error = format!("{:#}", list(&absent).unwrap_err());
        assert!(error.starts_with(&format!("folder {}: ", absent.display())), "{error}");
    }
}
