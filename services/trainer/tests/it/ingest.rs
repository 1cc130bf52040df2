//! Demonstration streams over real zenoh sessions: no episode is lost, stored twice, or stored invalid.

use crate::common::{self, commit, episode, files, info, record, sessions, steps};
use recording::Episode;
use std::time::Duration;
use tokio::task::JoinSet;
use trainer::record::folder::Recordings;
use trainer::record::ingest::Limits;
use trainer::record::send;
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse, DemonstrationStep, RecordedEpisode};
use wire::{Code, Error, Image, decode, encode, key, query};
use zenoh::Session;

async fn send(session: &Session, step: DemonstrationStep) {
    let key = key::demonstration_step(&step.episode_id, &step.step.to_string()).unwrap();
    session.put(key, encode(step)).congestion_control(zenoh::qos::CongestionControl::Block).await.unwrap();
}

/// Commits as a worker does, with retries while nobody answers.
async fn send_commit(session: &Session, request: &CommitEpisodeRequest) -> Result<Vec<u32>, Error> {
    let key = key::demonstration_commit(&request.episode.episode_id).unwrap();
    loop {
        let timeout = Duration::from_secs(10);
        match query::call::<_, CommitEpisodeResponse>(session, &key, request.clone(), timeout).await {
            Err(error) if error.code == Code::Unavailable => tokio::time::sleep(Duration::from_millis(20)).await,
            answer => return answer.map(|response| response.missing_steps),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_lossy_stream_is_stored_completely_in_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = sessions("tcp/127.0.0.1:17451").await;
    let _recorder = record(&trainer, folder.path(), Limits::default()).await;
    let episode = episode("door-lock", 3, 6);
    let (request, steps) = (commit(&episode), episode.steps());
    assert_eq!(send_commit(&worker, &request).await.unwrap(), [0, 1, 2, 3, 4, 5], "nothing was sent yet");
    for number in [0, 1, 3, 5, 1] {
        send(&worker, steps[number].clone()).await;
    }
    assert_eq!(send_commit(&worker, &request).await.unwrap(), [2, 4]);
    send(&worker, steps[2].clone()).await;
    send(&worker, steps[4].clone()).await;
    assert!(send_commit(&worker, &request).await.unwrap().is_empty(), "complete");
    assert!(send_commit(&worker, &request).await.unwrap().is_empty(), "an episode is kept once");
    assert_eq!(recording::read(&folder.path().join("door-lock/door-lock-3.mcap")).unwrap(), episode);

    let mut other = request.clone();
    other.episode.digest = "0".repeat(64);
    let error = send_commit(&worker, &other).await.unwrap_err();
    let expected = Error::new(Code::FailedPrecondition, "digest", &request.episode.digest, &other.episode.digest);
    assert_eq!(error, expected, "another episode under the same id");
}

#[tokio::test(flavor = "multi_thread")]
async fn an_invalid_episode_is_refused_and_the_next_one_stored() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = sessions("tcp/127.0.0.1:17452").await;
    let _recorder = record(&trainer, folder.path(), Limits::default()).await;
    let good = episode("reach", 1, 3);
    type Spoil = fn(&mut Vec<DemonstrationStep>);
    let cases: [(&str, Spoil); 6] = [
        ("steps[1].frame", |s| s[1].frame = Image::new(8, 8, vec![0; 192]).unwrap()),
        ("steps[2].action", |s| s[2].action = Some(vec![0.0; 4])),
        ("steps[1].action", |s| s[1].action = None),
        ("steps[0].action", |s| s[0].action = Some(vec![1.5; 4])),
        ("steps[1].frame.render_spec", |s| s[1].frame = s[1].frame.clone().rendered_as("other").unwrap()),
        ("digest", |s| s[1].reward = 9.0),
    ];
    for (field, spoil) in cases {
        let mut steps = good.steps().to_vec();
        spoil(&mut steps);
        let error = loop {
            for step in &steps {
                send(&worker, step.clone()).await;
            }
            // Steps sent before the worker discovered the recorder are missing, and sent again.
            if let Err(error) = send_commit(&worker, &commit(&good)).await {
                break error;
            }
        };
        assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, field));
    }
    worker.put(key::demonstration_step("reach-1", "0").unwrap(), [0xff; 9].as_slice()).await.unwrap();
    assert_eq!(send_commit(&worker, &commit(&good)).await.unwrap(), [0, 1, 2], "what was refused is forgotten");
    send::send(&worker, &good).await.unwrap();

    let mut steps = steps("reach", 2, 3);
    for step in &mut steps {
        step.frame = step.frame.clone().rendered_as("other").unwrap();
    }
    let other = Episode::new(info("reach", 2, &steps), steps).unwrap();
    let error = send::send(&worker, &other).await.unwrap_err();
    assert_eq!(error, Error::new(Code::FailedPrecondition, "render_spec", common::SPEC, "other"));
    assert_eq!(files(folder.path()).len(), 1);
}

/// One place and six concurrent senders: five wait at any time, and their steps are dropped.
#[tokio::test(flavor = "multi_thread")]
async fn an_overloaded_recorder_stores_everything_in_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = sessions("tcp/127.0.0.1:17453").await;
    let limits = Limits { episodes: 1, silence: Duration::MAX };
    let (_recorder, recordings) = record(&trainer, folder.path(), limits).await;
    let episodes: Vec<_> = (0..6).map(|seed| episode("reach", seed, 12)).collect();
    let mut senders = JoinSet::new();
    for episode in episodes.clone() {
        let worker = worker.clone();
        senders.spawn(async move { send::send(&worker, &episode).await });
    }
    while let Some(sent) = senders.join_next().await {
        sent.unwrap().unwrap();
    }
    for episode in episodes {
        assert_eq!(recordings.read(&episode.info().episode_id).unwrap(), Some(episode));
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_silent_episode_frees_its_place() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = sessions("tcp/127.0.0.1:17454").await;
    let (_recorder, _) = record(&trainer, folder.path(), Limits { episodes: 1, silence: Duration::ZERO }).await;
    assert_eq!(send_commit(&worker, &commit(&episode("reach", 1, 2))).await.unwrap(), [0, 1]);
    send::send(&worker, &episode("reach", 2, 2)).await.unwrap();
}

/// Stored episodes can be queried at the keys they were streamed at, with the same bytes.
#[tokio::test(flavor = "multi_thread")]
async fn stored_episodes_are_announced_listed_and_served() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = sessions("tcp/127.0.0.1:17455").await;
    let announced = trainer.declare_subscriber(key::demonstration_recorded("*").unwrap()).await.unwrap();
    let streamed = trainer.declare_subscriber(key::demonstration_step("*", "*").unwrap()).await.unwrap();
    let (recorder, _) = record(&trainer, folder.path(), Limits::default()).await;
    let (first, second) = (episode("reach", 1, 3), episode("push", 2, 4));
    send::send(&worker, &first).await.unwrap();
    let mut stream: Vec<_> =
        streamed.drain().map(|s| (s.key_expr().to_string(), s.payload().to_bytes().to_vec())).collect();
    send::send(&worker, &second).await.unwrap();
    for episode in [&first, &second] {
        let sample = announced.recv_async().await.unwrap();
        let key = key::demonstration_recorded(&episode.info().episode_id).unwrap();
        assert_eq!(sample.key_expr().as_str(), key.as_str());
        assert_eq!(decode::<RecordedEpisode>(&sample.payload().to_bytes()).unwrap(), *episode.info());
    }

    // A restarted recorder has the stored episodes.
    drop(recorder);
    // zenoh drops its callbacks, and with them the folder's lock, with a delay.
    while Recordings::open(folder.path().to_owned()).is_err() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    let (_recorder, _) = record(&trainer, folder.path(), Limits::default()).await;
    let list = |episode: &str| {
        let (key, worker) = (key::demonstration_recorded(episode).unwrap(), worker.clone());
        async move { query::collect::<RecordedEpisode>(&worker, &key, 9, Duration::from_secs(10)).await }
    };
    while list("*").await.unwrap().is_empty() {
        tokio::time::sleep(Duration::from_millis(10)).await;
    }
    assert_eq!(list("*").await.unwrap(), [second.info().clone(), first.info().clone()]);
    assert_eq!(list("reach-1").await.unwrap(), [first.info().clone()]);
    assert!(list("reach-7").await.unwrap().is_empty());

    let replies = worker.get(key::demonstration_step("reach-1", "*").unwrap()).await.unwrap();
    let mut again = Vec::new();
    while let Ok(reply) = replies.recv_async().await {
        let sample = reply.into_result().unwrap();
        again.push((sample.key_expr().to_string(), sample.payload().to_bytes().to_vec()));
    }
    again.sort();
    stream.sort();
    assert_eq!(again, stream);
    let one = key::demonstration_step("push-2", "3").unwrap();
    let answer = query::collect::<DemonstrationStep>(&worker, &one, 9, Duration::from_secs(10)).await.unwrap();
    assert_eq!(answer, second.steps()[3..]);
    let all = key::demonstration_step("*", "*").unwrap();
    let error = query::collect::<DemonstrationStep>(&worker, &all, 9, Duration::from_secs(10)).await.unwrap_err();
    assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, "key"));
}

#[test]
fn a_folder_of_a_killed_process_is_cleaned_and_reopened() {
    let folder = tempfile::tempdir().unwrap();
    common::keep(folder.path(), &episode("reach", 1, 3));
    let task = folder.path().join("reach");
    std::fs::write(task.join(".unfinished-abc"), "half").unwrap();
    std::fs::write(task.join("reach-2.mcap"), "no recording").unwrap();
    let recordings = Recordings::open(folder.path().to_owned()).unwrap();
    assert!(!task.join(".unfinished-abc").exists());
    assert_eq!(recordings.all(), [episode("reach", 1, 3).info().clone()]);
    recordings.keep(&episode("reach", 2, 3)).unwrap();
    assert_eq!(recordings.read("reach-2").unwrap(), Some(episode("reach", 2, 3)), "takes the place of the faulty file");
}
