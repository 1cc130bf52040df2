//! Live planners and workers, by liveliness tokens.

use anyhow::{Context, bail};
use service_kit::session::IntoAnyhow;
use std::collections::BTreeSet;
use std::fmt;
use std::future::pending;
use std::time::Duration;
use tokio::sync::watch;
use tokio::time::Instant;
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::sample::{Sample, SampleKind};

/// A service that trials are run with.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) enum Service {
    /// A planner, by name.
    Planner(String),
    /// A simulator worker, by name.
    Worker(String),
}

impl Service {
    /// Its name.
    pub(crate) fn name(&self) -> &str {
        match self {
            Self::Planner(name) | Self::Worker(name) => name,
        }
    }
}

impl fmt::Display for Service {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Planner(name) => write!(f, "planner {name}"),
            Self::Worker(name) => write!(f, "worker {name}"),
        }
    }
}

/// The planners and the workers that are alive.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub(crate) struct Alive {
    /// Live planners of the run.
    pub(crate) planners: BTreeSet<String>,
    /// The workers that are.
    pub(crate) workers: BTreeSet<String>,
}

impl Alive {
    /// Whether a service is away while another of its kind is there.
    pub(crate) fn can_replace(&self, service: &Service) -> bool {
        let (names, name) = match service {
            Service::Planner(name) => (&self.planners, name),
            Service::Worker(name) => (&self.workers, name),
        };
        !names.is_empty() && !names.contains(name)
    }
}

/// Follows the tokens of some planners and of all workers for as long as the session lives.
pub(crate) async fn follow(session: &Session, planners: &[String]) -> anyhow::Result<watch::Receiver<Alive>> {
    let (sender, receiver) = watch::channel(Alive::default());
    for planner in planners {
        let (sender, name) = (sender.clone(), planner.clone());
        let on_planner = move |sample: Sample| {
            sender.send_modify(|alive| update(&mut alive.planners, &name, sample.kind()));
        };
        subscribe(session, wire::key::planner_alive(planner)?, on_planner).await?;
    }
    let on_worker = move |sample: Sample| {
        let Some(worker) = wire::key::worker_of_sim_alive(sample.key_expr()) else { return };
        sender.send_modify(|alive| update(&mut alive.workers, &worker, sample.kind()));
    };
    subscribe(session, wire::key::sim_alive("*")?, on_worker).await?;
    Ok(receiver)
}

async fn subscribe(
    session: &Session,
    key: OwnedKeyExpr,
    callback: impl Fn(Sample) + Send + Sync + 'static,
) -> anyhow::Result<()> {
    let subscriber = session.liveliness().declare_subscriber(key).history(true).callback(callback).background();
    subscriber.await.into_anyhow().context("following liveliness tokens")
}

fn update(names: &mut BTreeSet<String>, name: &str, kind: SampleKind) {
    match kind {
        SampleKind::Put => names.insert(name.to_owned()),
        SampleKind::Delete => names.remove(name),
    };
}

/// Waits until a service has been away for `grace` while others of its kind were there. When all are away, it is the network
/// that is.
pub(crate) async fn gone(mut alive: watch::Receiver<Alive>, service: &Service, grace: Duration) {
    loop {
        if alive.wait_for(|alive| alive.can_replace(service)).await.is_err() {
            return pending().await;
        }
        let back = tokio::time::timeout(grace, alive.wait_for(|alive| !alive.can_replace(service)));
        match back.await.map(|back| back.is_err()) {
            Err(_) => return,
            // Nobody follows the tokens any more.
            Ok(true) => return pending().await,
            Ok(false) => (),
        }
    }
}

/// Waits until all the planners and so many workers are alive, for `patience` since `start`, and tells what is missing
/// meanwhile.
pub(crate) async fn wait(
    session: &Session,
    alive: &mut watch::Receiver<Alive>,
    planners: &[String],
    workers: u32,
    start: Instant,
    patience: Duration,
) -> anyhow::Result<()> {
    let missing = |alive: &Alive| {
        let planners = planners.iter().filter(|planner| !alive.planners.contains(*planner));
        let planners = planners.map(|planner| format!("planner \"{planner}\""));
        let got = alive.workers.len();
        let workers = (got < workers as usize).then(|| format!("simulator workers ({got} of {workers} there)"));
        let missing: Vec<_> = planners.chain(workers).collect();
        (!missing.is_empty()).then(|| missing.join(" and "))
    };
    let patient = async {
        loop {
            let Some(missing) = missing(&alive.borrow_and_update()) else { return anyhow::Ok(()) };
            tracing::info!("waiting up to {} s for {missing}", patience.as_secs());
            alive.changed().await?;
        }
    };
    match tokio::time::timeout_at(start + patience, patient).await {
        Ok(result) => result,
        Err(_) => {
            let missing = missing(&alive.borrow()).unwrap_or_default();
            let seconds = patience.as_secs();
            if !service_kit::session::is_connected(session).await {
                bail!("after {seconds} s still without {missing}: no router or peer is connected; is --connect right?");
            }
            bail!("after {seconds} s still without {missing}: are they running, and is --connect right?")
        }
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;

    fn alive(planners: &[&str], workers: &[&str]) -> Alive {
        let names = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        Alive { planners: names(planners), workers: names(workers) }
    }

    #[tokio::test]
    async fn a_service_is_gone_while_another_of_its_kind_is_there() {
        let worker = Service::Worker("w".into());
        // Both were alive; all are away, as while a router restarts; a planner is back.
        for kept in [alive(&["p"], &["v", "w"]), alive(&[], &[]), alive(&["p"], &[])] {
            let (sender, receiver) = watch::channel(kept);
            let gone = tokio::spawn(async move { gone(receiver, &Service::Worker("w".into()), Duration::ZERO).await });
            tokio::time::sleep(Duration::from_millis(50)).await;
            assert!(!gone.is_finished());
            sender.send_replace(alive(&[], &["v"]));
            gone.await.unwrap();
        }
        let (sender, receiver) = watch::channel(alive(&["p"], &["v"]));
        let hour = Duration::from_secs(3600);
        let gone = tokio::spawn(async move { gone(receiver, &worker, hour).await });
        sender.send_replace(alive(&["p"], &["v", "w"]));
        tokio::time::sleep(Duration::from_millis(50)).await;
        assert!(!gone.is_finished(), "it came back in time");
    }
}
