//! Recording of a trial in one MCAP file: every camera frame, and every plan request with its response.

use crate::ReadError;
use crate::camera::{frame, raw_image};
use crate::file::{Reader, Writer, bytes, check, check_size};
use crate::topic::Topic;
use mcap::McapError;
use prost::{Message as _, Name};
use proto::plan_request::Observed;
use std::io::Read;
use std::path::Path;
use std::time::Duration;
use wire::planner::{Goal, PlanRequest, PlanResponse};
use wire::trial::RecordedTrial;
use wire::{Error, Image, Observation, decode, proto};

/// Camera frame, before the first action or after one.
#[derive(Debug, Clone, PartialEq)]
pub struct Frame {
    /// The image.
    pub image: Image,
    /// Time since the start of the episode.
    pub time: Duration,
}

/// Plan request and its response.
#[derive(Debug, Clone, PartialEq)]
pub struct Exchange {
    /// Number of actions applied before.
    pub step: u32,
    /// Request, as sent.
    pub request: PlanRequest,
    /// Time of the request, since the start of the episode.
    pub asked: Duration,
    /// Response, as received.
    pub response: PlanResponse,
    /// Time of the response, since the start of the episode.
    pub answered: Duration,
}

/// Valid recording of a trial: its plans are all by one checkpoint and towards one goal.
#[derive(Debug, Clone, PartialEq)]
pub struct Recording {
    trial: RecordedTrial,
    frames: Vec<Frame>,
    exchanges: Vec<Exchange>,
}

impl Recording {
    /// Recording of a trial, from its frames and plans in the order of the steps.
    ///
    /// # Errors
    /// If the number of frames or plans, or the render spec of a frame, is not that of the trial; or the model, checkpoint, goal,
    /// step or image of a plan is not. The error names frame or plan, and field.
    pub fn new(trial: RecordedTrial, frames: Vec<Frame>, exchanges: Vec<Exchange>) -> Result<Self, Error> {
        check("frames", &(u64::from(trial.steps) + 1).to_string(), &frames.len().to_string())?;
        check("plans", &trial.plans.to_string(), &exchanges.len().to_string())?;
        for (step, Frame { image, .. }) in frames.iter().enumerate() {
            check("render_spec", trial.goal.render_spec(), image.render_spec())
                .map_err(|e| e.within(&format!("frames[{step}]")))?;
        }

        let expected_goal = trial.planned_goal().digest();
        let mut first_step = 0;
        for (plan, Exchange { step, request, response, .. }) in exchanges.iter().enumerate() {
            let fits = || {
                if !(first_step..trial.steps).contains(step) {
                    let expected = format!("at least {first_step} and less than {}", trial.steps);
                    return Err(Error::invalid("step", expected, step));
                }
                if let Observation::Image(image) = &request.observation
                    && *image != frames[*step as usize].image
                {
                    return Err(Error::invalid("request.observation", format!("frame {step}"), "another image"));
                }
                check("request.model", &trial.model, &request.model)?;
                check("request.goal", &expected_goal, &goal_id(&request.goal))?;
                check("response.model_digest", &trial.model_digest, &response.model_digest)
            };
            fits().map_err(|e| e.within(&format!("plans[{plan}]")))?;
            first_step = step + 1;
        }
        Ok(Self { trial, frames, exchanges })
    }

    /// Metadata of the trial.
    pub fn trial(&self) -> &RecordedTrial {
        &self.trial
    }

    /// Frames from the one before the first action to the one after the last, at least two.
    pub fn frames(&self) -> &[Frame] {
        &self.frames
    }

    /// Plans in the order of the steps.
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

/// Encodes the recording of a trial.
///
/// # Errors
/// If the encoder fails.
pub fn to_bytes(Recording { trial, frames, exchanges }: &Recording) -> Result<Vec<u8>, McapError> {
    let mut writer = Writer::new(&[Topic::Trial, Topic::Camera, Topic::PlanRequest, Topic::PlanResponse])?;
    writer.write(Topic::Trial, 0, 0, &proto::RecordedTrial::from(trial.clone()))?;
    let nanos = |time: Duration| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX);
    let mut exchanges = exchanges.iter().peekable();
    for (step, Frame { image, time }) in (0..).zip(frames) {
        let time = nanos(*time);
        writer.write(Topic::Camera, step, time, &raw_image(image, time))?;
        if let Some(exchange) = exchanges.next_if(|exchange| exchange.step == step) {
            let Exchange { request, asked, response, answered, .. } = exchange.clone();
            writer.write(Topic::PlanRequest, step, nanos(asked), &without_image(request))?;
            writer.write(Topic::PlanResponse, step, nanos(answered), &proto::PlanResponse::from(response))?;
        }
    }
    writer.finish()
}

/// Decodes the recording of a trial: a header, then each frame, with the plan request and response that follow it.
///
/// # Errors
/// If it is too large, truncated, damaged (every part has a checksum), or not of one trial.
pub fn from_bytes(bytes: &[u8]) -> Result<Recording, ReadError> {
    check_size(bytes.len())?;
    let mut reader = Reader::new(bytes);
    let (trial, _) = of_step::<RecordedTrial>(&mut reader, Topic::Trial, 0, decode)?;
    let (mut frames, mut exchanges) = (Vec::new(), Vec::new());
    for step in 0..=trial.steps {
        let as_frame = |data: &[u8]| frame(data, trial.goal.render_spec());
        let (image, time) = of_step(&mut reader, Topic::Camera, step, as_frame)?;
        if reader.next_is(Topic::PlanRequest)? {
            let (request, asked) =
                of_step(&mut reader, Topic::PlanRequest, step, |data: &[u8]| with_image(data, &image))?;
            let (response, answered) = of_step(&mut reader, Topic::PlanResponse, step, decode)?;
            exchanges.push(Exchange { step, request, asked, response, answered });
        }
        frames.push(Frame { image, time });
    }

    reader.end("steps", trial.steps)?;
    Ok(Recording::new(trial, frames, exchanges)?)
}

/// Reads the file of a trial.
///
/// # Errors
/// As [`from_bytes`], or if the file cannot be read.
pub fn read(path: &Path) -> Result<Recording, ReadError> {
    from_bytes(&bytes(path)?)
}

/// Reads the next message, which must be of this topic and step, and its time.
fn of_step<T>(
    reader: &mut Reader<impl Read>,
    topic: Topic,
    step: u32,
    decode: impl Fn(&[u8]) -> Result<T, Error>,
) -> Result<(T, Duration), ReadError> {
    let message = reader.of(topic)?;
    check(topic.name(), &format!("number {step}"), &format!("number {}", message.sequence))?;
    let value = decode(&message.data).map_err(|e| e.within(&format!("{}[{step}]", topic.name())))?;
    Ok((value, Duration::from_nanos(message.log_time)))
}

/// Request as it is stored: an image as its observation is the frame before it.
fn without_image(request: PlanRequest) -> proto::PlanRequest {
    let mut request = proto::PlanRequest::from(request);
    request.observed = request.observed.filter(|observed| matches!(observed, Observed::Position(_)));
    request
}

/// Request as it was sent, from the stored one and the frame before it.
fn with_image(data: &[u8], frame: &Image) -> Result<PlanRequest, Error> {
    let request = proto::PlanRequest::decode(data);
    let mut request = request.map_err(|e| Error::invalid("payload", proto::PlanRequest::full_name(), e))?;
    request.observed.get_or_insert_with(|| Observed::Observation(frame.clone().into()));
    request.try_into()
}
