//! Commands whose standard output cannot be written.

use crate::common::{episode, keep};
use std::fs::File;
use std::process::{Command, ExitStatus, Stdio};
use tempfile::TempDir;

fn trainer(arguments: &[&str], folder: &TempDir) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
    command.args(arguments).current_dir(folder).stdin(Stdio::null());
    command
}

/// Exit status and standard error of a command with a closed standard output.
fn unread(mut command: Command) -> (ExitStatus, String) {
    let (reader, writer) = std::io::pipe().unwrap();
    drop(reader);
    let output = command.stdout(writer).output().unwrap();
    (output.status, String::from_utf8(output.stderr).unwrap())
}

/// Exit status and standard error of a command whose standard output is on a full disk.
fn full(mut command: Command) -> (ExitStatus, String) {
    let output = command.stdout(File::options().write(true).open("/dev/full").unwrap()).output().unwrap();
    (output.status, String::from_utf8(output.stderr).unwrap())
}

#[test]
fn a_closed_output_ends_quietly_and_a_full_disk_is_named() {
    let folder = TempDir::new().unwrap();
    keep(&folder.path().join("data"), &episode("reach", 1, 4));
    let train = ["train", "--json", "--preset", "paper-bc", "--dataset", "data", "--out", "x.safetensors"];
    for arguments in
        [&["preset", "cpn"][..], &["verify", "--dataset", "data"], &["verify", "--dataset", "data", "--json"]]
    {
        let (status, said) = unread(trainer(arguments, &folder));
        assert!(status.success() && said.is_empty(), "{arguments:?}: {status}: {said}");
        let (status, said) = full(trainer(arguments, &folder));
        let expected = "Error: standard output /dev/full\n\nCaused by:\n    No space left on device";
        assert!(status.code() == Some(1) && said.starts_with(expected), "{arguments:?}: {status}: {said}");
    }
    // A run saves its state first.
    for (ended, code) in [(unread(trainer(&train, &folder)), 0), (full(trainer(&train, &folder)), 1)] {
        let (status, said) = ended;
        assert_eq!(status.code(), Some(code), "{said}");
        assert_eq!(said.contains("standard output /dev/full"), code == 1, "{said}");
        assert!(folder.path().join("x.resume").exists(), "{said}");
    }
}

/// A log that cannot be written does not stop a command.
#[test]
fn a_full_log_is_no_error() {
    let folder = TempDir::new().unwrap();
    keep(&folder.path().join("data"), &episode("reach", 1, 4));
    let settings = ["--set", "training.epochs=1", "--set", "training.batch_size=4"];
    let train = ["train", "--preset", "paper-bc", "--dataset", "data", "--out", "x.safetensors"];
    let mut command = trainer(&[&train[..], &settings].concat(), &folder);
    let status = command.stderr(File::options().write(true).open("/dev/full").unwrap()).status().unwrap();
    assert!(status.success(), "{status}");
    assert!(folder.path().join("x.safetensors").exists());
}
