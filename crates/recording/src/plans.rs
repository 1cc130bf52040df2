//! Recorded plans of an episode, in one MCAP file: every plan request with its response.

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

/// Plan request and its response.
#[derive(Debug, Clone, PartialEq)]
pub struct Exchange {
    /// Request, as sent.
    pub request: PlanRequest,
    /// Time of the request, since the start of the episode.
    pub asked: Duration,
    /// Response, as received.
    pub response: PlanResponse,
    /// Time of the response, since the start of the episode.
    pub answered: Duration,
}

/// Valid plans of an episode: all by one checkpoint and towards one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Plans {
    episode: PlannedEpisode,
    exchanges: Vec<Exchange>,
}

impl Plans {
    /// Plans of an episode, in the order of the steps.
    ///
    /// # Errors
    /// If their number, or the model, checkpoint or goal of one of them, is not that of the episode. The error names the step
    /// and field.
    pub fn new(episode: PlannedEpisode, exchanges: Vec<Exchange>) -> Result<Self, Error> {
        check("plans", &episode.plans.to_string(), &exchanges.len().to_string())?;
        let expected_goal = episode.goal.digest();
        for (step, Exchange { request, response, .. }) in exchanges.iter().enumerate() {
            let fits = || {
                check("request.model", &episode.model, &request.model)?;
                check("request.goal", &expected_goal, &goal_id(&request.goal))?;
                check("response.model_digest", &episode.model_digest, &response.model_digest)
            };
            fits().map_err(|e| e.within(&format!("plans[{step}]")))?;
        }
        Ok(Self { episode, exchanges })
    }

    /// Metadata of the episode.
    pub fn episode(&self) -> &PlannedEpisode {
        &self.episode
    }

    /// Plans in the order of the steps, at least one.
    pub fn exchanges(&self) -> &[Exchange] {
        &self.exchanges
    }
}

/// Goal id, as planners compute it.
fn goal_id(goal: &Goal) -> String {
    match goal {
        Goal::Id(id) => id.clone(),
        Goal::Image(image) => image.digest(),
        Goal::Position(position) => Observation::from(*position).digest(),
    }
}

/// Encodes the recording of an episode's plans.
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

/// Decodes the recording of an episode's plans: a header, then each request and its response, in order.
///
/// # Errors
/// If it is too large, truncated, damaged (every part has a checksum), or not the plans of one episode.
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

/// Reads the next message, which must be of this topic and step, and its time.
fn of_step<M: Message>(reader: &mut Reader<impl Read>, topic: Topic, step: u32) -> Result<(M, Duration), ReadError> {
    let message = reader.of(topic)?;
    check(topic.name(), &format!("number {step}"), &format!("number {}", message.sequence))?;
    let value = decode(&message.data).map_err(|e: Error| e.within(&format!("{}[{step}]", topic.name())))?;
    Ok((value, Duration::from_nanos(message.log_time)))
}
