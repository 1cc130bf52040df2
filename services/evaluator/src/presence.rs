//! Who is alive, by liveliness tokens.

use anyhow::{anyhow, bail};
use std::collections::BTreeSet;
use std::time::Duration;
use tokio::sync::watch;
use zenoh::Session;
use zenoh::sample::{Sample, SampleKind};

/// The planner and the workers that are alive.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Alive {
    /// Whether the planner is.
    pub(crate) planner: bool,
    /// The workers that are.
    pub(crate) workers: BTreeSet<String>,
}

/// Follows the tokens of a planner and of all workers for as long as the session lives.
pub(crate) async fn follow(session: &Session, planner: &str) -> anyhow::Result<watch::Receiver<Alive>> {
    let (sender, receiver) = watch::channel(Alive::default());
    let planner_sender = sender.clone();
    let on_planner = move |sample: Sample| {
        planner_sender.send_modify(|alive| alive.planner = sample.kind() == SampleKind::Put);
    };
    let on_worker = move |sample: Sample| {
        let Some(worker) = wire::key::worker_of_sim_alive(sample.key_expr()) else { return };
        sender.send_modify(|alive| {
            match sample.kind() {
                SampleKind::Put => alive.workers.insert(worker),
                SampleKind::Delete => alive.workers.remove(&worker),
            };
        });
    };
    let tokens = session.liveliness();
    let planner_alive = wire::key::planner_alive(planner)?;
    tokens
        .declare_subscriber(planner_alive)
        .history(true)
        .callback(on_planner)
        .background()
        .await
        .map_err(unfollowed)?;
    let sim_alive = wire::key::sim_alive("*")?;
    tokens.declare_subscriber(sim_alive).history(true).callback(on_worker).background().await.map_err(unfollowed)?;
    Ok(receiver)
}

fn unfollowed(error: zenoh::Error) -> anyhow::Error {
    anyhow!(error).context("following liveliness tokens")
}

/// Waits until the planner and so many workers are alive, and tells what is missing meanwhile.
pub(crate) async fn wait(
    alive: &mut watch::Receiver<Alive>,
    planner: &str,
    workers: u32,
    patience: Duration,
) -> anyhow::Result<()> {
    let missing = |alive: &Alive| {
        let planner = (!alive.planner).then(|| format!("planner \"{planner}\""));
        let got = alive.workers.len();
        let workers = (got < workers as usize).then(|| format!("simulator workers ({got} of {workers} there)"));
        let missing: Vec<_> = planner.into_iter().chain(workers).collect();
        (!missing.is_empty()).then(|| missing.join(" and "))
    };
    let patient = async {
        loop {
            let Some(missing) = missing(&alive.borrow_and_update()) else { return anyhow::Ok(()) };
            tracing::info!("waiting up to {} s for {missing}", patience.as_secs());
            alive.changed().await?;
        }
    };
    match tokio::time::timeout(patience, patient).await {
        Ok(result) => result,
        Err(_) => {
            let missing = missing(&alive.borrow()).unwrap_or_default();
            bail!("after {} s still without {missing}: are they running, and is --connect right?", patience.as_secs())
        }
    }
}
