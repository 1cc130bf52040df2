//! Requests, answers and metadata, with the field names of openpi's clients.

use super::numpy::{self, Array, Fields, brief};
use crate::core::PlannerCore;
use crate::model::RANDOM;
use rmpv::Value;
use wire::planner::{Goal, ListModelsResponse, MAX_STEPS_LEFT, ModelInfo, PlanRequest, PlanResponse, StageTimes};
use wire::{Error, Image, Observation, Position};

const OBSERVATION_IMAGE: &str = "observation/image";
const OBSERVATION_POSITION: &str = "observation/position";
const GOAL_IMAGE: &str = "goal/image";
const GOAL_POSITION: &str = "goal/position";
const GOAL_ID: &str = "goal/id";
const MODEL: &str = "model";
const SEED: &str = "seed";
const STEPS_LEFT: &str = "steps_left";
const PROMPT: &str = "prompt";

/// Fields of a request.
const FIELDS: [&str; 9] =
    [OBSERVATION_IMAGE, OBSERVATION_POSITION, GOAL_IMAGE, GOAL_POSITION, GOAL_ID, MODEL, SEED, STEPS_LEFT, PROMPT];

/// Name and parser of a field.
type Reader<T> = (&'static str, fn(Value) -> Result<T, Error>);

const OBSERVATION: [Reader<Observation>; 2] = [
    (OBSERVATION_IMAGE, |value| Ok(Observation::Image(image(value)?))),
    (OBSERVATION_POSITION, |value| Ok(Observation::Position(position(value)?))),
];
const GOAL: [Reader<Goal>; 3] = [
    (GOAL_IMAGE, |value| Ok(Goal::Image(image(value)?))),
    (GOAL_POSITION, |value| Ok(Goal::Position(position(value)?))),
    (GOAL_ID, |value| Ok(Goal::Id(text(value)?))),
];

/// Metadata for a new client: the served models, and the shape of their images.
pub(super) fn metadata(core: &PlannerCore) -> Vec<u8> {
    let model = |info: ModelInfo| {
        let tasks: Vec<_> = info.training_tasks.into_iter().map(Value::from).collect();
        let fields = [
            ("method", info.method.into()),
            ("digest", info.digest.into()),
            ("version", info.version.into()),
            ("horizon", info.horizon.into()),
            ("training_tasks", tasks.into()),
        ];
        (info.name, numpy::map(fields))
    };
    let image_shape = [cpn::images::SIZE, cpn::images::SIZE, 3].map(Value::from).to_vec();
    let models = numpy::map(core.list_models().models.into_iter().map(model));
    numpy::write(&numpy::map([("models", models), ("image_shape", image_shape.into())]))
}

/// Decodes a plan request; `models` are the served models.
///
/// # Errors
/// `INVALID_ARGUMENT` with the field that is missing, unknown, duplicate or invalid.
pub fn request(payload: &[u8], models: impl FnOnce() -> ListModelsResponse) -> Result<PlanRequest, Error> {
    let mut fields = numpy::read(payload)?;
    // A field that is None in Python counts as missing.
    fields.retain(|_, value| !value.is_nil());
    if let Some(name) = fields.keys().find(|name| !FIELDS.contains(&name.as_str())) {
        return Err(Error::invalid("payload", format!("fields among {}", FIELDS.join(", ")), name));
    }

    match fields.remove(PROMPT) {
        None => (),
        Some(prompt) if text(prompt.clone()).is_ok_and(|prompt| prompt.is_empty()) => (),
        Some(prompt) => {
            return Err(Error::invalid(PROMPT, "none: the goal is a picture or a position", brief(&prompt)));
        }
    }

    let observation = one_of("observation", OBSERVATION, &mut fields)?;
    let goal = one_of("goal", GOAL, &mut fields)?;
    let model = match fields.remove(MODEL) {
        Some(name) => text(name).map_err(|e| e.within(MODEL))?,
        None => only_model(models())?,
    };
    let seed = fields.remove(SEED).map_or(Ok(0), seed).map_err(|e| e.within(SEED))?;
    let steps_left = fields.remove(STEPS_LEFT).map(steps_left).transpose().map_err(|e| e.within(STEPS_LEFT))?;
    Ok(PlanRequest { seed, steps_left, ..PlanRequest::new(model, goal, observation) })
}

/// Value of the only given field among `readers`.
fn one_of<T, const N: usize>(what: &str, readers: [Reader<T>; N], fields: &mut Fields) -> Result<T, Error> {
    let expected = format!("one of {}", readers.map(|(name, _)| name).join(", "));
    let mut given = readers.into_iter().filter_map(|(name, read)| Some((name, read, fields.remove(name)?)));
    match (given.next(), given.next()) {
        (Some((name, read, value)), None) => read(value).map_err(|e| e.within(name)),
        (Some((first, ..)), Some((second, ..))) => Err(Error::invalid(what, expected, format!("{first} and {second}"))),
        (None, _) => Err(Error::invalid(what, expected, "none")),
    }
}

/// Default model of a request: the only trained one.
fn only_model(served: ListModelsResponse) -> Result<String, Error> {
    let mut names: Vec<_> = served.models.into_iter().map(|info| info.name).collect();
    names.retain(|name| name != RANDOM);
    match &mut names[..] {
        [name] => Ok(std::mem::take(name)),
        [] => Err(Error::invalid(MODEL, RANDOM, "none")),
        _ => Err(Error::invalid(MODEL, format!("one of {}", names.join(", ")), "none")),
    }
}

fn image(value: Value) -> Result<Image, Error> {
    let array = Array::try_from(value)?;
    match (array.dtype.as_str(), &array.shape[..]) {
        ("|u1", &[height, width, 3]) => Image::new(height, width, array.data),
        _ => Err(Error::invalid("", "dtype |u1 (uint8), shape [height, width, 3]", array)),
    }
}

fn position(value: Value) -> Result<Position, Error> {
    let array = Array::try_from(value)?;
    match (array.dtype.as_str(), &array.shape[..], array.data.as_chunks()) {
        ("<f4", [3], (&[x, y, z], [])) => Position::new([x, y, z].map(f32::from_le_bytes)),
        _ => Err(Error::invalid("", "dtype <f4 (float32), shape [3], 12 bytes", array)),
    }
}

fn text(value: Value) -> Result<String, Error> {
    match numpy::scalar(value) {
        Value::Binary(bytes) => String::from_utf8(bytes)
            .map_err(|error| Error::invalid("", "text", format!("{} bytes", error.as_bytes().len()))),
        value => value.as_str().map(str::to_owned).ok_or_else(|| Error::invalid("", "text", brief(&value))),
    }
}

fn seed(value: Value) -> Result<u64, Error> {
    let value = numpy::scalar(value);
    value.as_u64().ok_or_else(|| Error::invalid("", "an integer from 0 to 2^64 - 1", brief(&value)))
}

fn steps_left(value: Value) -> Result<u32, Error> {
    let value = numpy::scalar(value);
    let steps = value.as_u64().and_then(|steps| u32::try_from(steps).ok());
    steps
        .filter(|steps| (1..=MAX_STEPS_LEFT).contains(steps))
        .ok_or_else(|| Error::invalid("", format!("an integer from 1 to {MAX_STEPS_LEFT}"), brief(&value)))
}

/// Encodes an answer: the actions to execute, `[H, A]`, clipped to [-1, 1], with their provenance and timings.
pub(super) fn answer(plan: PlanResponse) -> Vec<u8> {
    let clipped = |action: Vec<f32>| action.into_iter().map(|value| value.clamp(-1.0, 1.0)).collect();
    let actions: Vec<_> = plan.actions.into_iter().map(clipped).collect();
    let StageTimes { queue_seconds, encode_seconds, plan_seconds } = plan.times;
    let ms = |seconds: f64| Value::from(seconds * 1e3);
    let server = [("infer_ms", ms(queue_seconds + encode_seconds + plan_seconds)), ("queue_ms", ms(queue_seconds))];
    let policy = [
        ("infer_ms", ms(encode_seconds + plan_seconds)),
        ("encode_ms", ms(encode_seconds)),
        ("plan_ms", ms(plan_seconds)),
    ];
    numpy::write(&numpy::map([
        ("actions", numpy::matrix(&actions)),
        ("latent_distance", plan.latent_distance.map_or(Value::Nil, Value::from)),
        ("model_digest", plan.model_digest.into()),
        ("goal_id", plan.goal_id.into()),
        ("server_timing", numpy::map(server)),
        ("policy_timing", numpy::map(policy)),
    ]))
}

/// Translates the field name of a planner's error to that of openpi's clients.
pub(super) fn renamed(mut error: Error) -> Error {
    let (field, rest) = error.field.split_once('.').unwrap_or((&error.field, ""));
    let name = match field {
        "observation" => OBSERVATION_IMAGE,
        "position" => OBSERVATION_POSITION,
        "goal_image" => GOAL_IMAGE,
        "goal_position" => GOAL_POSITION,
        "goal_id" => GOAL_ID,
        _ => return error,
    };
    error.field = rest.to_owned();
    error.within(name)
}
