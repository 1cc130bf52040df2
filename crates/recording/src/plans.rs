//! The plans of an episode as an MCAP file: every request to a planner and its answer, as they were.

use crate::ReadError;
use crate::file::{Reader, Writer, bytes, check, check_size};
use crate::topic::Topic;
use mcap::McapError;
use std::io::Read;
use std::path::Path;
use std::time::Duration;
use wire::planner::{Goal, PlanRequest, PlanResponse};
use wire::replay::PlannedEpisode;
use wire::{Error, Message, Observation, decode, proto};

/// A request and its answer.
#[derive(Debug, Clone, PartialEq)]
pub struct Exchange {
    /// As it was sent.
    pub request: PlanRequest,
    /// When, since the start of the episode.
    pub asked: Duration,
    /// As it came.
    pub response: PlanResponse,
    /// When, since the start of the episode.
    pub answered: Duration,
}

/// The plans of an episode. Those that are built are of one model's checkpoint and towards one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Plans {
    episode: PlannedEpisode,
    exchanges: Vec<Exchange>,
}

impl Plans {
    /// Puts the plans of an episode together, in the order of the steps.
    ///
    /// # Errors
    /// Names the step and field that does not fit: another model, checkpoint or goal than the episode's, or another number
    /// of plans.
    pub fn new(episode: PlannedEpisode, exchanges: Vec<Exchange>) -> Result<Self, Error> {
        check("plans", &episode.plans.to_string(), &exchanges.len().to_string())?;
        let goal_id = episode.goal.digest();
        for (step, Exchange { request, response, .. }) in exchanges.iter().enumerate() {
            let fits = || {
                check("request.model", &episode.model, &request.model)?;
                check("request.goal", &goal_id, &id(&request.goal))?;
                check("response.model_digest", &episode.model_digest, &response.model_digest)
            };
            fits().map_err(|e| e.within(&format!("plans[{step}]")))?;
        }
        Ok(Self { episode, exchanges })
    }

    /// What is known of the episode.
    pub fn episode(&self) -> &PlannedEpisode {
        &self.episode
    }

    /// The plans in the order of the steps, at least one.
    pub fn exchanges(&self) -> &[Exchange] {
        &self.exchanges
    }
}

/// The id under which a planner knows a goal.
fn id(goal: &Goal) -> String {
    match goal {
        Goal::Id(id) => id.clone(),
        Goal::Image(image) => image.digest(),
        Goal::Position(position) => Observation::from(*position).digest(),
    }
}

/// The recording of an episode's plans.
///
/// # Errors
/// If the encoder fails.
pub fn to_bytes(plans: &Plans) -> Result<Vec<u8>, McapError> {
    let mut writer = Writer::new(&[Topic::PlannedEpisode, Topic::PlanRequest, Topic::PlanResponse])?;
    writer.write(Topic::PlannedEpisode, 0, 0, &proto::PlannedEpisode::from(plans.episode.clone()))?;
    let nanos = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    for (step, exchange) in (0..).zip(&plans.exchanges) {
        let Exchange { request, asked, response, answered } = exchange.clone();
        writer.write(Topic::PlanRequest, step, nanos(asked), &proto::PlanRequest::from(request))?;
        writer.write(Topic::PlanResponse, step, nanos(answered), &proto::PlanResponse::from(response))?;
    }
    writer.finish()
}

/// Reads the recording of an episode's plans.
///
/// # Errors
/// If it is too large, truncated, damaged (every part has a checksum), or does not hold the plans of one episode: a
/// header, then each request and its answer, in order.
pub fn from_bytes(bytes: &[u8]) -> Result<Plans, ReadError> {
    check_size(bytes.len())?;
    let mut reader = Reader::new(bytes);
    let (episode, _) = of_step::<PlannedEpisode>(&mut reader, Topic::PlannedEpisode, 0)?;
    let mut exchanges = Vec::new();
    for step in 0..episode.plans {
        let (request, asked) = of_step(&mut reader, Topic::PlanRequest, step)?;
        let (response, answered) = of_step(&mut reader, Topic::PlanResponse, step)?;
        exchanges.push(Exchange { request, asked, response, answered });
    }
    reader.end("plans", episode.plans - 1)?;
    Ok(Plans::new(episode, exchanges)?)
}

/// Reads the file of an episode's plans.
///
/// # Errors
/// As [`from_bytes`], or if the file cannot be read.
pub fn read(path: &Path) -> Result<Plans, ReadError> {
    from_bytes(&bytes(path)?)
}

/// The next message, which must be of this topic and step, and its time.
fn of_step<M: Message>(reader: &mut Reader<impl Read>, topic: Topic, step: u32) -> Result<(M, Duration), ReadError> {
    let message = reader.of(topic)?;
    check(topic.name(), &format!("number {step}"), &format!("number {}", message.sequence))?;
    let value = decode(&message.data).map_err(|e: Error| e.within(&format!("{}[{step}]", topic.name())))?;
    Ok((value, Duration::from_nanos(message.log_time)))
}
