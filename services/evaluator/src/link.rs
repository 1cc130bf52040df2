//! Requests to planners and workers, asked again while a router or the service itself is away.
//!
//! Asking twice changes nothing: plans follow from their requests, a goal's id from its picture, a step is applied once by
//! its number, and a reset that comes late ends the episode, so that the next step is refused.

use crate::presence::{self, Alive, Service};
use anyhow::bail;
use service_kit::SessionConfig;
use service_kit::network::{Retry, ask, is_outage};
use std::time::Duration;
use tokio::sync::watch;
use wire::{Code, Error, Message};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// Time for which a service may be away, while others of its kind are there, before it is taken as gone. After a router's
/// restart the tokens come back one by one, within a second or two.
const GRACE: Duration = Duration::from_secs(5);

/// The way to the planners and the workers.
#[derive(Debug, Clone)]
pub(crate) struct Link {
    pub(crate) session: Session,
    /// Limit of one try.
    pub(crate) timeout: Duration,
    /// Time, from the first failed try, within which a router or a service may come back.
    pub(crate) recovery: Duration,
    pub(crate) alive: watch::Receiver<Alive>,
}

impl Link {
    /// A service's answer, however often it must be asked for.
    ///
    /// # Errors
    /// The service's answer; the last error if an outage lasts; [`Code::Unavailable`] once the service is gone for good.
    pub(crate) async fn call<Q: Message + Clone, R: Message>(
        &self,
        service: &Service,
        key: OwnedKeyExpr,
        request: Q,
    ) -> Result<R, Error> {
        tokio::select! {
            biased;
            answer = ask(&self.session, &key, request, self.timeout, retry(self.recovery)) => answer,
            () = presence::gone(self.alive.clone(), service, GRACE) => {
                let got = format!("none for {} s, while others are alive", GRACE.as_secs());
                Err(Error::new(Code::Unavailable, key.as_str(), format!("{service} to be alive"), got))
            }
        }
    }
}

/// Retries until so long after the first outage.
pub(crate) fn retry(patience: Duration) -> Retry {
    Retry { delays: [Duration::from_millis(200), Duration::from_secs(1)], patience, when: is_outage }
}

/// Joins the others.
///
/// # Errors
/// If the session cannot be opened, or its router is not there within `patience`.
pub(crate) async fn join(config: &SessionConfig, patience: Duration) -> anyhow::Result<Session> {
    match tokio::time::timeout(patience, service_kit::session::open(config)).await {
        Ok(session) => session,
        Err(_) => {
            let (routers, seconds) = (config.connect.join(", "), patience.as_secs());
            bail!("no router at {routers} within {seconds} s: is it running, and is --connect right?")
        }
    }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "a test")]
mod tests {
    use super::*;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};
    use wire::sim::{ResetRequest, ResetResponse, Variation};
    use wire::{key, query};
    use zenoh::Wait;
    use zenoh::query::Query;

    fn alive(planners: &[&str], workers: &[&str]) -> Alive {
        let names = |names: &[&str]| names.iter().map(ToString::to_string).collect();
        Alive { planners: names(planners), workers: names(workers) }
    }

    async fn link(recovery: Duration) -> (Link, watch::Sender<Alive>) {
        let session = service_kit::session::open(&SessionConfig::default()).await.unwrap();
        let (sender, alive) = watch::channel(alive(&["p"], &["w", "v"]));
        (Link { session, timeout: Duration::from_secs(60), recovery, alive }, sender)
    }

    async fn reset(link: &Link) -> Result<ResetResponse, Error> {
        let variation = Variation { task: "reach".into(), seed: 1 };
        let request = ResetRequest { variation, goal_seed: None };
        link.call(&Service::Worker("w".into()), key::sim_reset("w").unwrap(), request).await
    }

    async fn serve(link: &Link, answer: impl Fn(&Query) + Send + Sync + 'static) {
        let queryable = link.session.declare_queryable(key::sim_reset("w").unwrap()).complete(true);
        queryable.callback(move |query| answer(&query)).background().await.unwrap();
    }

    fn refuse(query: &Query, code: Code) {
        query::refuse(query, Error::new(code, "field", "one thing", "another")).unwrap();
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn an_outage_is_asked_through_and_a_refusal_is_not() {
        let (link, _alive) = link(Duration::from_secs(60)).await;
        let asked = Arc::new(AtomicUsize::new(0));
        let count = asked.clone();
        serve(&link, move |query| match count.fetch_add(1, Ordering::SeqCst) {
            0 => refuse(query, Code::Unavailable),
            // Zenoh's own reply when the time is up.
            1 => query.reply_err("Timeout").wait().unwrap(),
            2 => refuse(query, Code::ResourceExhausted),
            _ => refuse(query, Code::NotFound),
        })
        .await;
        assert_eq!(reset(&link).await.unwrap_err().code, Code::NotFound);
        assert_eq!(asked.load(Ordering::SeqCst), 4);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_service_that_comes_up_is_found_and_an_outage_that_stays_is_told() {
        let (link, _alive) = link(Duration::from_secs(60)).await;
        let late = async {
            tokio::time::sleep(Duration::from_millis(300)).await;
            serve(&link, |query| refuse(query, Code::Internal)).await;
        };
        assert_eq!(tokio::join!(reset(&link), late).0.unwrap_err().code, Code::Internal);

        let (link, _alive) = self::link(Duration::ZERO).await;
        assert_eq!(reset(&link).await.unwrap_err().code, Code::Unavailable);
    }

    #[tokio::test(flavor = "multi_thread")]
    async fn a_service_that_is_gone_while_others_are_alive_is_not_waited_for() {
        // Nobody answers: without liveliness these would wait for an hour.
        let (link, sender) = link(Duration::from_secs(3600)).await;
        let gone = reset(&link);
        sender.send_replace(alive(&["p"], &["v"]));
        let error = gone.await.unwrap_err();
        assert_eq!((error.code, error.expected.as_str()), (Code::Unavailable, "worker w to be alive"));
    }
}
