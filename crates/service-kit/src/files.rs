//! Files that are there whole or not at all.

use anyhow::{Context, bail};
use std::ffi::OsStr;
use std::fs::{File, Permissions};
use std::io::{Read, Write};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// How the names of temporary files begin.
const UNFINISHED: &str = ".unfinished-";
/// Name of the file in a folder that the process that keeps it has locked.
const LOCK: &str = ".lock";
/// Most that is read of who has locked a file, in bytes.
const MAX_KEEPER_BYTES: u64 = 1024;
/// Folder of the file system's own, at the top of one.
const LOST_AND_FOUND: &str = "lost+found";

/// Makes a folder, if there is none, and takes it over for as long as the answer lives: two processes would each know a
/// part of what is in it.
///
/// # Errors
/// If the folder cannot be made, or another process has it, which the error names.
pub fn take_over(folder: &Path) -> anyhow::Result<File> {
    lock(folder, LOCK).with_context(|| folder.display().to_string())
}

/// The same for a single file, and whatever this process writes beside it: its folder may hold those of others.
///
/// # Errors
/// If its folder cannot be made, or another process has the file, which the error names.
pub fn take_over_file(path: &Path) -> anyhow::Result<File> {
    let take_over = || {
        let name = path.file_name().context("expected the path of a file")?;
        lock(path.parent().unwrap_or(path), &format!(".{}{LOCK}", name.to_string_lossy()))
    };
    take_over().with_context(|| path.display().to_string())
}

/// Locks a file of a folder, which then says who has it.
fn lock(folder: &Path, name: &str) -> anyhow::Result<File> {
    std::fs::create_dir_all(folder)?;
    let path = folder.join(name);
    // What the other process wrote stays.
    let mut lock = File::options().read(true).write(true).create(true).truncate(false).open(&path)?;
    if let Err(error) = lock.try_lock() {
        let std::fs::TryLockError::WouldBlock = error else { return Err(error.into()) };
        let mut keeper = String::new();
        // Who has it may not have written so yet.
        let _ = lock.take(MAX_KEEPER_BYTES).read_to_string(&mut keeper);
        let keeper = if keeper.is_empty() { "another process" } else { keeper.trim() };
        bail!("expected one that no process keeps, got that of {keeper}");
    }
    // That it can be named is a convenience.
    let _ = lock.set_len(0).and_then(|()| lock.write_all(keeper().as_bytes()));
    Ok(lock)
}

/// This process, as people look for it.
fn keeper() -> String {
    let host = std::fs::read_to_string("/proc/sys/kernel/hostname").unwrap_or_default();
    let program = std::env::args().next().unwrap_or_default();
    let program = Path::new(&program).file_name().unwrap_or_default().to_string_lossy();
    format!("process {} ({program}) on {}\n", std::process::id(), host.trim())
}

/// The paths in a folder, ordered by name. Those that belong to nobody are left out: names that begin with a dot, which
/// systems, editors and unfinished writes leave behind, and `lost+found`.
///
/// # Errors
/// If the folder is not there or cannot be read.
pub fn list(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let list = || {
        let paths = std::fs::read_dir(folder)?.map(|entry| Ok(entry?.path())).collect::<std::io::Result<Vec<_>>>()?;
        std::io::Result::Ok(paths)
    };
    let mut paths = list().with_context(|| format!("folder {}", folder.display()))?;
    paths.retain(|path| path.file_name().is_some_and(|name| !is_nobodys(name)));
    paths.sort();
    Ok(paths)
}

fn is_nobodys(name: &OsStr) -> bool {
    name.as_encoded_bytes().starts_with(b".") || name == LOST_AND_FOUND
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

/// All bytes of a regular file.
///
/// # Errors
/// If it cannot be read, is no regular file, or has more than so many bytes.
pub fn read_all(path: &Path, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    let bytes = read_at_most(path, max_bytes + 1)?;
    if bytes.len() > max_bytes {
        return Err(std::io::Error::other(format!("expected at most {max_bytes} bytes, got more")));
    }
    Ok(bytes)
}

/// The same of a file of this name in a folder: never of one elsewhere, to which a symbolic link leads.
///
/// # Errors
/// If it cannot be read, is no regular file, or lies elsewhere.
pub fn read_inside(folder: &Path, name: &str, max_bytes: usize) -> std::io::Result<Vec<u8>> {
    let other = std::io::Error::other;
    let path = folder.join(name).canonicalize()?;
    if !path.starts_with(folder.canonicalize()?) {
        return Err(other("a link to a file outside the folder"));
    }
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

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;

    #[test]
    fn a_folder_and_a_file_have_one_keeper_who_is_named() {
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
    fn what_is_nobodys_is_not_listed_and_a_folder_that_is_not_there_is_an_error() {
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
