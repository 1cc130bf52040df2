//! Recordings: sending, mirroring, verification.

use crate::common::{episode, files, info, keep, record, sessions, steps};
use cpn::Input;
use recording::Episode;
use rustix::process::{Pid, Signal, kill_process};
use std::path::Path;
use std::process::Stdio;
use std::sync::Arc;
use std::time::Duration;
use trainer::record::folder::Recordings;
use trainer::record::ingest::Limits;
use trainer::record::{mirror, send, verify};
use trainer::training::dataset::Dataset;
use wire::demonstration::{DemonstrationStep, RecordedEpisode};
use wire::{Code, Image};

fn dataset(folder: &Path) {
    for (task, seed, steps) in [("push", 0, 4), ("reach", 0, 3), ("reach", 2, 5)] {
        keep(folder, &episode(task, seed, steps));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replayed_dataset_is_identical() {
    let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    dataset(from.path());
    let (trainer, sender) = sessions("tcp/127.0.0.1:17471").await;
    let _recorder = record(&trainer, to.path(), Limits::default()).await;
    send::run(&sender, from.path(), &["push".to_owned()]).await.unwrap();
    assert_eq!(files(to.path()), files(from.path())[..1], "one task");
    for _ in 0..2 {
        send::run(&sender, from.path(), &[]).await.unwrap();
        assert_eq!(files(to.path()), files(from.path()));
    }
    let error = send::run(&sender, from.path(), &["pull".to_owned()]).await.unwrap_err().to_string();
    assert_eq!(error, r#"tasks: expected some of ["push", "reach"], got "pull""#);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mirror_fetches_earlier_and_later_episodes() {
    let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    dataset(from.path());
    keep(to.path(), &episode("reach", 2, 5));
    let (trainer, joiner) = sessions("tcp/127.0.0.1:17472").await;
    let _recorder = record(&trainer, from.path(), Limits::default()).await;
    let copies = Arc::new(Recordings::open(to.path().to_owned()).unwrap());
    mirror::once(&joiner, &copies).await.unwrap();
    assert_eq!(files(to.path()), files(from.path()));

    let following = {
        let (joiner, copies) = (joiner.clone(), Arc::clone(&copies));
        tokio::spawn(async move { mirror::follow(&joiner, &copies, usize::MAX).await })
    };
    for seed in 3..6 {
        send::send(&joiner, &episode("reach", seed, 4)).await.unwrap();
    }
    let caught_up = async {
        while copies.all().len() < 6 {
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    tokio::time::timeout(Duration::from_secs(60), caught_up).await.expect("the new episodes to be mirrored");
    following.abort();
    assert_eq!(files(to.path()), files(from.path()));
}

/// The real training process, started before the last demonstrations exist, and interrupted once.
#[tokio::test(flavor = "multi_thread")]
async fn a_run_mirrors_demonstrations_until_it_has_enough() {
    let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    dataset(from.path());
    let endpoint = "tcp/127.0.0.1:17474";
    let (trainer, sender) = sessions(endpoint).await;
    let _recorder = record(&trainer, from.path(), Limits::default()).await;
    let (copies, out) = (to.path().join("data"), to.path().join("live.safetensors"));

    let start = || {
        let mut command = tokio::process::Command::new(env!("CARGO_BIN_EXE_cpn-trainer"));
        command.args(["train", "--json", "--preset", "paper-bc", "--set", "training.batch_size=8"]);
        command.args(["--set", "training.epochs=1", "--demonstrations", "5", "--connect", endpoint, "--dataset"]);
        command.args([&copies, Path::new("--out"), &out, Path::new("--run-dir"), &to.path().join("run")]);
        command.kill_on_drop(true).stdout(Stdio::piped()).spawn().unwrap()
    };

    let stopped = start();
    while !copies.is_dir() || files(&copies) != files(from.path()) {
        tokio::time::sleep(Duration::from_millis(20)).await;
    }
    kill_process(Pid::from_raw(stopped.id().unwrap().cast_signed()).unwrap(), Signal::TERM).unwrap();
    let stopped = stopped.wait_with_output().await.unwrap();
    assert!(stopped.status.success());
    let told: serde_json::Value = serde_json::from_slice(&stopped.stdout).unwrap();
    assert_eq!(told, serde_json::json!({"interrupted": {"step": 0}}), "three are not enough");

    let run = start();
    for seed in 3..5 {
        send::send(&sender, &episode("reach", seed, 4)).await.unwrap();
    }
    let ended = tokio::time::timeout(Duration::from_secs(60), run.wait_with_output()).await.expect("the run to end");
    assert!(ended.unwrap().status.success());
    assert_eq!(files(&copies), files(from.path()));

    let trained = cpn::checkpoint::from_bytes(&std::fs::read(out).unwrap()).unwrap().provenance;
    let all = Dataset::load(from.path(), &[], Input::Image).unwrap();
    assert_eq!(trained.data_digest, all.digest());
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mirror_refuses_a_different_episode_of_the_same_id() {
    let [from, to] = [(); 2].map(|()| tempfile::tempdir().unwrap());
    dataset(from.path());
    keep(to.path(), &episode("reach", 2, 7));
    let (trainer, joiner) = sessions("tcp/127.0.0.1:17473").await;
    let _recorder = record(&trainer, from.path(), Limits::default()).await;
    let copies = Arc::new(Recordings::open(to.path().to_owned()).unwrap());
    let error = mirror::once(&joiner, &copies).await.unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, "reach-2.digest"));
    assert_eq!(copies.read("reach-2").unwrap(), Some(episode("reach", 2, 7)), "left as it was");
    assert_eq!(copies.all().len(), 3, "the others are copied all the same");
}

#[test]
fn verify_reports_the_contents_of_a_dataset() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let report = verify::run(folder.path(), 1, 1).unwrap();
    assert_eq!(report.faults, Vec::<String>::new());
    let rows: Vec<_> =
        report.tasks.iter().map(|t| (t.task.as_str(), t.episodes, t.skipped_seeds, t.steps_mean)).collect();
    assert_eq!(rows, [("push", 1, 0, 4.0), ("reach", 2, 1, 4.0)]);
    assert_eq!(report.digest, Dataset::load(folder.path(), &[], Input::Image).unwrap().digest());
    let text = report.to_string();
    assert!(text.contains("reach") && text.contains(&report.digest), "{text}");
}

/// Faults of a dataset with a planted one.
fn faults(plant: impl FnOnce(&mut RecordedEpisode, &mut Vec<DemonstrationStep>)) -> Vec<String> {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let mut steps = steps("reach", 3, 4);
    let mut info = info("reach", 3, &steps);
    plant(&mut info, &mut steps);
    info.digest = wire::demonstration::digest(&steps);
    info.render_spec = steps[0].frame.render_spec().to_owned();
    let bytes = recording::to_bytes(&Episode::new(info, steps).unwrap()).unwrap();
    std::fs::write(folder.path().join("reach/reach-3.mcap"), bytes).unwrap();
    verify::run(folder.path(), 1, 1).unwrap().faults
}

#[test]
fn verify_finds_faults_inside_an_episode() {
    let place = "reach/reach-3.mcap: ";
    assert_eq!(faults(|_, _| ()), Vec::<String>::new(), "nothing is wrong before it is planted");

    let found = faults(|_, steps| steps[2].frame = steps[1].frame.clone());
    assert_eq!(found, [format!("{place}expected another frame at step 2 than at 1: the hand moved 0.0100 m")]);
    let found = faults(|_, steps| {
        steps[2].frame = steps[1].frame.clone();
        steps[2].state = steps[1].state.clone();
    });
    assert_eq!(found, Vec::<String>::new(), "where nothing moves, the picture may stay");
    let found = faults(|_, steps| {
        let first = steps[0].frame.clone();
        steps.iter_mut().for_each(|step| step.frame = first.clone());
    });
    assert_eq!(found, [format!("{place}expected frames that change, got the same in every step")]);

    let found = faults(|_, steps| steps[3].success = false);
    assert_eq!(found, [format!("{place}expected success at the last step, got none")]);
    let found = faults(|_, steps| {
        let real = |frame: &Image| frame.clone().rendered_as("").unwrap();
        steps.iter_mut().for_each(|step| step.frame = real(&step.frame));
    });
    assert!(found.len() == 1 && found[0].starts_with("render_spec: expected one, got 2: {\"\", "), "{found:?}");
    let found = faults(|info, _| info.control_hz = 40.0);
    assert_eq!(found, [r#"control_hz: expected one, got 2: {"40", "80"}"#]);
}

/// A recording's path decides whether it is held out of a training, so that a misplaced one is refused.
#[test]
fn a_misplaced_recording_is_refused() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let wrong = folder.path().join("push/reach-2.mcap");
    std::fs::rename(folder.path().join("reach/reach-2.mcap"), &wrong).unwrap();
    let faults = verify::run(folder.path(), 1, 1).unwrap().faults;
    assert!(matches!(&faults[..], [fault] if fault.contains("place: expected") && fault.contains("push/reach-2.mcap")));
    let error = Dataset::load(folder.path(), &["reach".into()], Input::Image).unwrap_err();
    assert!(format!("{error:#}").contains("place: expected"), "{error:#}");
    let recordings = Recordings::open(folder.path().to_owned()).unwrap();
    assert_eq!(recordings.get("reach-2"), None, "passed over, so that it can be recorded again");
    recordings.keep(&episode("reach", 2, 5)).unwrap();
    assert_eq!(recordings.read("reach-2").unwrap(), Some(episode("reach", 2, 5)));
}

/// Only intact files on disk count as stored, also while the recorder runs.
#[test]
fn a_truncated_or_removed_recording_is_recorded_again() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let (path, whole) = (folder.path().join("reach/reach-2.mcap"), episode("reach", 2, 5));
    let bytes = std::fs::read(&path).unwrap();
    let cut = &bytes[..bytes.len() / 2];
    assert!(recording::read_header(&path).is_ok_and(|info| info == *whole.info()));

    std::fs::write(&path, cut).unwrap();
    assert!(recording::read_header(&path).is_ok(), "its header is whole");
    let recordings = Recordings::open(folder.path().to_owned()).unwrap();
    type Damage<'a> = Box<dyn Fn() + 'a>;
    let damages: [Damage; 4] = [
        Box::new(|| ()),
        Box::new(|| std::fs::write(&path, cut).unwrap()),
        Box::new(|| std::fs::remove_file(&path).unwrap()),
        Box::new(|| std::fs::rename(&path, folder.path().join("push/reach-2.mcap")).unwrap()),
    ];
    for (index, damage) in damages.iter().enumerate() {
        damage();
        let kept = recordings.all();
        assert_eq!((recordings.count(), kept.iter().any(|info| info.episode_id == "reach-2")), (2, false), "{index}");
        assert_eq!((recordings.get("reach-2"), recordings.contains("reach-2")), (None, false), "{index}");
        assert_eq!(recordings.read("reach-2").unwrap(), None, "{index}");
        assert_eq!(recordings.lacks(whole.info()), Ok(true), "{index}");
        recordings.keep(&whole).unwrap();
        assert_eq!(std::fs::read(&path).unwrap(), bytes, "{index}");
        assert_eq!(recordings.get("reach-2").as_ref(), Some(whole.info()), "{index}");
    }
}

/// Files that others put into the folder are not overwritten, and removed ones no longer determine the render spec.
#[test]
fn a_recorder_notices_changes_by_others_in_its_folder() {
    let folder = tempfile::tempdir().unwrap();
    let recordings = Recordings::open(folder.path().to_owned()).unwrap();
    recordings.keep(&episode("reach", 0, 3)).unwrap();
    let copied = recording::to_bytes(&episode("reach", 1, 3)).unwrap();
    let path = folder.path().join("reach/reach-1.mcap");
    std::fs::write(&path, &copied).unwrap();
    let error = recordings.keep(&episode("reach", 1, 4)).unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, "digest"));
    assert_eq!((std::fs::read(&path).unwrap(), recordings.count()), (copied, 2));

    let mut others = steps("push", 3, 4);
    others.iter_mut().for_each(|step| step.frame = step.frame.clone().rendered_as("other").unwrap());
    let other = Episode::new(info("push", 3, &others), others).unwrap();
    assert_eq!(recordings.keep(&other).unwrap_err().field, "render_spec");
    std::fs::remove_dir_all(folder.path().join("reach")).unwrap();
    recordings.keep(&other).unwrap();
    assert_eq!(recordings.all(), [other.info().clone()]);
}

/// Every reader refuses two recordings of one id.
#[test]
fn two_recordings_of_one_id_are_refused() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let mut info = info("push", 2, &episode("reach", 2, 5).into_steps());
    info.episode_id = "reach-2".into();
    let twin = Episode::new(info, episode("reach", 2, 5).into_steps()).unwrap();
    std::fs::write(folder.path().join("push/reach-2.mcap"), recording::to_bytes(&twin).unwrap()).unwrap();
    let found = "reach/reach-2.mcap: expected an id that no other episode has, got that of ";
    let faults = verify::run(folder.path(), 1, 1).unwrap().faults;
    assert!(matches!(&faults[..], [fault] if fault.contains(found)), "{faults:?}");
    let error = Dataset::load(folder.path(), &[], Input::Image).unwrap_err().to_string();
    assert!(error.contains(found), "{error}");
    Dataset::load(folder.path(), &["push".into()], Input::Image).unwrap();
    assert_eq!(Recordings::open(folder.path().to_owned()).unwrap().count(), 3);
}

/// Hidden files of other programs in the folder are ignored.
#[test]
fn hidden_files_are_ignored() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let before = (verify::run(folder.path(), 1, 1).unwrap().digest, files(folder.path()));
    for stray in ["reach/._reach-0.mcap", ".Trash-1000/reach-0.mcap", "lost+found/reach-0.mcap", "._push"] {
        let stray = folder.path().join(stray);
        std::fs::create_dir_all(stray.parent().unwrap()).unwrap();
        std::fs::write(stray, "not a recording").unwrap();
    }
    let report = verify::run(folder.path(), 1, 1).unwrap();
    assert_eq!((report.faults, report.tasks.len(), (report.digest, files(folder.path()))), (vec![], 2, before));
    assert_eq!(Dataset::load(folder.path(), &[], Input::Image).unwrap().tasks().len(), 2);
    assert_eq!(Recordings::open(folder.path().to_owned()).unwrap().count(), 3);
    let error = format!("{:#}", verify::run(&folder.path().join("absent"), 1, 1).unwrap_err());
    assert!(error.contains("absent"), "{error}");
}

#[test]
fn a_folder_has_one_recorder_and_an_id_one_episode() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let recordings = Recordings::open(folder.path().to_owned()).unwrap();
    let error = Recordings::open(folder.path().to_owned()).unwrap_err();
    let (error, keeper) = (format!("{error:#}"), format!("got that of process {} (", std::process::id()));
    assert!(error.contains("expected one that no process keeps") && error.contains(&keeper), "{error}");

    let kept = recordings.get("reach-0").unwrap();
    assert_eq!(recordings.lacks(&kept), Ok(false));
    let offers = [
        ("digest", RecordedEpisode { digest: "0".repeat(64), ..kept.clone() }),
        ("render_spec", RecordedEpisode { render_spec: "other".into(), ..kept.clone() }),
        ("control_hz", RecordedEpisode { control_hz: 10.0, ..kept.clone() }),
        ("render_spec", RecordedEpisode { render_spec: "other".into(), episode_id: "reach-9".into(), ..kept.clone() }),
    ];
    for (field, offered) in offers {
        let error = recordings.lacks(&offered).unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (Code::FailedPrecondition, field));
    }
    recordings.keep(&episode("reach", 0, 4)).unwrap_err();
    assert_eq!(recordings.read("reach-0").unwrap(), Some(episode("reach", 0, 3)), "left as it was");
}

#[test]
fn verify_finds_faults_of_the_dataset() {
    let folder = tempfile::tempdir().unwrap();
    dataset(folder.path());
    let path = folder.path().join("push/push-0.mcap");
    let mut bytes = std::fs::read(&path).unwrap();
    let middle = bytes.len() / 2;
    bytes[middle] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let faults = verify::run(folder.path(), 1, 2).unwrap().faults;
    assert!(faults[0].contains("push-0.mcap: recording: Chunk CRC failed"), "{faults:?}");
    assert_eq!(faults[1..], ["push: expected at least 2 episodes, got 0"]);

    let mut still = steps("stay", 0, 3);
    still.iter_mut().filter_map(|step| step.action.as_mut()).for_each(|action| *action = vec![0.0; 4]);
    std::fs::remove_file(path).unwrap();
    keep(folder.path(), &Episode::new(info("stay", 0, &still), still).unwrap());
    let faults = verify::run(folder.path(), 1, 0).unwrap().faults;
    assert_eq!(faults, ["stay: expected actions that change, got constant ones in every episode"]);
    let faults = verify::run(folder.path(), 9, 0).unwrap().faults;
    assert_eq!(faults[0], "expected at least 9 tasks, got 3");
    let nothing = tempfile::tempdir().unwrap();
    assert!(verify::run(nothing.path(), 0, 0).unwrap().faults[0].ends_with("expected recordings, got none"));
}
