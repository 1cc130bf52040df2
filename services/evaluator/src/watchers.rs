//! Plans of a trial under way, published for watchers.

use crate::link::Link;
use recording::trial::Exchange;
use wire::trial::TrialPlan;
use wire::{Code, Error, encode, key, query};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

/// Publisher of a trial's plans. A slow watcher misses plans; the trial waits for none.
pub(crate) struct Watchers<'a> {
    publisher: Publisher<'a>,
    episode_id: String,
    model: String,
}

impl<'a> Watchers<'a> {
    /// The publisher of an episode of a worker.
    ///
    /// # Errors
    /// If the worker's name is not valid in a key, or the session is closed.
    pub(crate) async fn new(link: &'a Link, worker: &str, episode_id: &str, model: &str) -> Result<Self, Error> {
        let declared = link.session.declare_publisher(key::sim_plan(worker)?);
        let publisher = declared
            .congestion_control(CongestionControl::Drop)
            .encoding(query::encoding::<wire::proto::TrialPlan>())
            .await
            .map_err(|error| Error::new(Code::Unavailable, "session", "an open one", error))?;
        Ok(Self { publisher, episode_id: episode_id.to_owned(), model: model.to_owned() })
    }

    /// Publishes a plan.
    pub(crate) async fn show(&self, Exchange { step, response, .. }: &Exchange) {
        let (episode_id, model) = (self.episode_id.clone(), self.model.clone());
        let plan = TrialPlan { episode_id, step: *step, model, plan: response.clone() };
        if let Err(error) = self.publisher.put(encode(plan)).await {
            tracing::debug!("a plan was not published: {error}");
        }
    }
}
