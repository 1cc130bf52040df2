//! Demonstration streams over real zenoh sessions: nothing is lost, nothing is kept twice, nothing wrong is kept.

#![expect(clippy::unwrap_used, reason = "a test")]

mod common;

use common::{commit, step};
use service_kit::SessionConfig;
use std::path::Path;
use std::time::Duration;
use trainer::episode::Episode;
use trainer::service;
use wire::demonstration::{CommitEpisodeRequest, CommitEpisodeResponse, DemonstrationStep};
use wire::{Code, Error, Image, encode, key, query};
use zenoh::Session;

/// A trainer that keeps episodes in `folder`, and a worker's session.
async fn start(folder: &Path, endpoint: &str) -> (service::Service, Session) {
    let session = SessionConfig { listen: vec![endpoint.into()], ..SessionConfig::default() };
    let (dataset, checkpoints) = (folder.join("data"), folder.join("checkpoints"));
    let trainer = service::start(service::Config { dataset, checkpoints, session }).await.unwrap();
    let session = SessionConfig { connect: vec![endpoint.into()], ..SessionConfig::default() };
    (trainer, service_kit::session::open(&session).await.unwrap())
}

async fn send(session: &Session, step: DemonstrationStep) {
    let key = key::demonstration_step(&step.episode_id, &step.step.to_string()).unwrap();
    session.put(key, encode(step)).congestion_control(zenoh::qos::CongestionControl::Block).await.unwrap();
}

/// Commits as a worker does: again as long as nobody answers.
async fn send_commit(session: &Session, request: &CommitEpisodeRequest) -> Result<Vec<u32>, Error> {
    let key = key::demonstration_commit(&request.episode_id).unwrap();
    loop {
        let timeout = Duration::from_secs(10);
        match query::call::<_, CommitEpisodeResponse>(session, &key, request.clone(), timeout).await {
            Err(error) if error.code == Code::Unavailable => tokio::time::sleep(Duration::from_millis(20)).await,
            answer => return answer.map(|response| response.missing_steps),
        }
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_with_losses_is_kept_whole_in_the_end() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = start(folder.path(), "tcp/127.0.0.1:17451").await;
    let request = commit("door-lock", 3, 6);
    assert_eq!(send_commit(&worker, &request).await.unwrap(), [0, 1, 2, 3, 4, 5], "nothing was sent yet");
    for number in [0, 1, 3, 5, 1] {
        send(&worker, step(&request, number)).await;
    }
    assert_eq!(send_commit(&worker, &request).await.unwrap(), [2, 4]);
    send(&worker, step(&request, 2)).await;
    send(&worker, step(&request, 4)).await;
    assert!(send_commit(&worker, &request).await.unwrap().is_empty(), "complete");
    assert!(send_commit(&worker, &request).await.unwrap().is_empty(), "an episode is kept once");

    let episode = Episode::read(&folder.path().join("data/door-lock/door-lock-3.safetensors")).unwrap();
    assert_eq!((episode.action_count(), episode.info.task.as_str(), episode.info.seed), (5, "door-lock", 3));
    for number in 0..6u32 {
        let sent = step(&request, number);
        let frame = Vec::<u8>::try_from(episode.frames.get(number.into()).view(-1)).unwrap();
        assert_eq!(frame, sent.frame.data(), "frame {number}");
        if let Some(action) = sent.action {
            assert_eq!(Vec::<f32>::try_from(episode.actions.get(number.into())).unwrap(), action);
        }
    }
    trainer.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn what_is_no_episode_is_refused_and_the_next_one_kept() {
    let folder = tempfile::tempdir().unwrap();
    let (trainer, worker) = start(folder.path(), "tcp/127.0.0.1:17452").await;
    let request = commit("reach", 1, 3);
    type Spoil<'a> = &'a dyn Fn(u32, &mut DemonstrationStep);
    let cases: [(&str, Spoil<'_>); 4] = [
        ("steps[1].frame", &|number, step| {
            if number == 1 {
                step.frame = Image::new(8, 8, vec![0; 192]).unwrap();
            }
        }),
        ("steps[2].action", &|_, step| step.action = Some(vec![0.0; 4])),
        ("steps[1].action", &|number, step| step.action = (number == 0).then(|| vec![0.0; 4])),
        ("steps[0].action", &|_, step| step.action = step.action.take().map(|_| vec![1.5; 4])),
    ];
    for (field, spoil) in cases {
        for number in 0..3 {
            let mut step = step(&request, number);
            spoil(number, &mut step);
            send(&worker, step).await;
        }
        let error = send_commit(&worker, &request).await.unwrap_err();
        assert_eq!((error.code, error.field.as_str()), (Code::InvalidArgument, field));
    }
    worker.put(key::demonstration_step("reach-1", "0").unwrap(), [0xff; 9].as_slice()).await.unwrap();
    assert_eq!(send_commit(&worker, &request).await.unwrap(), [0, 1, 2], "what was refused is forgotten");
    for number in 0..3 {
        send(&worker, step(&request, number)).await;
    }
    assert!(send_commit(&worker, &request).await.unwrap().is_empty());
    trainer.shutdown().await.unwrap();
}
