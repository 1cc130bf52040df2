//! Plans of a trial under way, published for watchers.

use crate::link::Link;
use recording::trial::Exchange;
use service_kit::session::IntoAnyhow;
use wire::sim::TrialPlan;
use wire::{encode, key, query};
use zenoh::pubsub::Publisher;
use zenoh::qos::CongestionControl;

/// Publisher of a trial's plans. A slow watcher misses plans; the trial waits for none.
pub(crate) struct Watchers<'a> {
    publisher: Publisher<'a>,
    episode_id: String,
    model: String,
}

impl<'a> Watchers<'a> {
    /// The publisher of an episode of a worker; none if it cannot be declared, since a trial goes on without watchers.
    pub(crate) async fn new(link: &'a Link, worker: &str, episode_id: &str, model: &str) -> Option<Self> {
        let publisher =
            declare(link, worker).await.inspect_err(|error| tracing::debug!("plans are not published: {error}"));
        Some(Self { publisher: publisher.ok()?, episode_id: episode_id.to_owned(), model: model.to_owned() })
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

async fn declare<'a>(link: &'a Link, worker: &str) -> anyhow::Result<Publisher<'a>> {
    let declared = link.session.declare_publisher(key::sim_plan(worker)?).congestion_control(CongestionControl::Drop);
    declared.encoding(query::encoding::<wire::proto::TrialPlan>()).await.into_anyhow()
}
