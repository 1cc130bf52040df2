//! Open Inference Protocol (KServe v2) over gRPC: plans for clients of Triton.
//!
//! The inputs are the tensors `observation` and `goal`, UINT8 `[84, 84, 3]` or FP32 `[3]`, and `steps_left`, INT32 `[1]`; the output is
//! `plan`, FP32 `[H, A]`. There is no batch dimension: concurrent requests are batched by the model thread.

use crate::core::PlannerCore;
use crate::grpc::request_span;
use crate::model::Description;
use cpn::{Input, images};
use std::collections::BTreeMap;
use std::fmt;
use std::time::Duration;
use tonic::{Request, Response, Status};
use tracing::Instrument;
use wire::inference::grpc_inference_service_server::GrpcInferenceService;
use wire::inference::infer_parameter::ParameterChoice;
use wire::inference::model_infer_request::InferInputTensor;
use wire::inference::model_infer_response::InferOutputTensor;
use wire::inference::model_metadata_response::TensorMetadata;
use wire::inference::{
    InferParameter, InferTensorContents, ModelConfig, ModelConfigRequest, ModelConfigResponse, ModelInferRequest,
    ModelInferResponse, ModelMetadataRequest, ModelMetadataResponse, ModelReadyRequest, ModelReadyResponse,
    ServerLiveRequest, ServerLiveResponse, ServerMetadataRequest, ServerMetadataResponse, ServerReadyRequest,
    ServerReadyResponse,
};
use wire::planner::{Goal, MAX_ITERATIONS, MAX_STEPS_LEFT, PlanRequest, PlanResponse, Search, Solver};
use wire::{Code, Error, Image, Observation, Position};

/// Names of the tensors.
const OBSERVATION: &str = "observation";
const GOAL: &str = "goal";
const STEPS_LEFT: &str = "steps_left";
const PLAN: &str = "plan";

/// Datatype of the elements of an image, of a position or plan, and of a number of steps.
const UINT8: &str = "UINT8";
const FP32: &str = "FP32";
const INT32: &str = "INT32";

/// Shape of an image, of a position, and of a number of steps.
const IMAGE: [i64; 3] = [images::SIZE, images::SIZE, images::CHANNELS];
const POSITION: [i64; 1] = [3];
const SCALAR: [i64; 1] = [1];

/// Implementation of the generated service.
pub(crate) struct Inference(pub(crate) PlannerCore);

impl Inference {
    /// Description of a model, whose digest is the only version.
    fn describe(&self, name: &str, version: &str) -> Result<Description, Error> {
        let model = self.0.describe(name).map_err(|e| Error { field: "name".into(), ..e })?;
        if version.is_empty() || version == model.info.digest {
            return Ok(model);
        }
        Err(Error::new(Code::NotFound, "version", model.info.digest, version))
    }
}

#[tonic::async_trait]
impl GrpcInferenceService for Inference {
    async fn server_live(&self, _: Request<ServerLiveRequest>) -> Result<Response<ServerLiveResponse>, Status> {
        Ok(Response::new(ServerLiveResponse { live: true }))
    }

    async fn server_ready(&self, _: Request<ServerReadyRequest>) -> Result<Response<ServerReadyResponse>, Status> {
        Ok(Response::new(ServerReadyResponse { ready: true }))
    }

    async fn model_ready(&self, request: Request<ModelReadyRequest>) -> Result<Response<ModelReadyResponse>, Status> {
        let ModelReadyRequest { name, version } = request.into_inner();
        Ok(Response::new(ModelReadyResponse { ready: self.describe(&name, &version).is_ok() }))
    }

    async fn server_metadata(
        &self,
        _: Request<ServerMetadataRequest>,
    ) -> Result<Response<ServerMetadataResponse>, Status> {
        Ok(Response::new(ServerMetadataResponse {
            name: env!("CARGO_PKG_NAME").into(),
            version: env!("CARGO_PKG_VERSION").into(),
            extensions: vec!["model_configuration".into()],
        }))
    }

    async fn model_metadata(
        &self,
        request: Request<ModelMetadataRequest>,
    ) -> Result<Response<ModelMetadataResponse>, Status> {
        let ModelMetadataRequest { name, version } = request.into_inner();
        Ok(Response::new(metadata(self.describe(&name, &version)?)))
    }

    async fn model_config(
        &self,
        request: Request<ModelConfigRequest>,
    ) -> Result<Response<ModelConfigResponse>, Status> {
        let ModelConfigRequest { name, version } = request.into_inner();
        let config = ModelConfig { name: self.describe(&name, &version)?.info.name };
        Ok(Response::new(ModelConfigResponse { config: Some(config) }))
    }

    async fn model_infer(&self, received: Request<ModelInferRequest>) -> Result<Response<ModelInferResponse>, Status> {
        let span = request_span(received.metadata(), "GRPCInferenceService/ModelInfer");
        let mut received = received.into_inner();
        let id = std::mem::take(&mut received.id);
        let request = request(received)?;
        let model = request.model.clone();
        let plan = self.0.plan(request).instrument(span).await.map_err(renamed)?;
        Ok(Response::new(response(model, id, plan)))
    }
}

fn metadata(Description { info, input, actions, takes_steps_left }: Description) -> ModelMetadataResponse {
    let tensor = |name: &str, datatype: &str, shape: &[i64]| TensorMetadata {
        name: name.into(),
        datatype: datatype.into(),
        shape: shape.into(),
    };
    let observed = |name| match input {
        Input::Image => tensor(name, UINT8, &IMAGE),
        Input::Position => tensor(name, FP32, &POSITION),
    };
    let steps_left = takes_steps_left.then(|| tensor(STEPS_LEFT, INT32, &SCALAR));
    ModelMetadataResponse {
        name: info.name,
        versions: vec![info.digest],
        platform: "cpn".into(),
        inputs: [observed(OBSERVATION), observed(GOAL)].into_iter().chain(steps_left).collect(),
        outputs: vec![tensor(PLAN, FP32, &[info.horizon.into(), actions as i64])],
    }
}

/// Decodes a plan request.
///
/// # Errors
/// `INVALID_ARGUMENT` with the tensor, parameter or output that is missing, unknown, duplicate or invalid.
pub fn request(request: ModelInferRequest) -> Result<PlanRequest, Error> {
    let ModelInferRequest { model_name, model_version, id: _, mut parameters, inputs, outputs, raw_input_contents } =
        request;
    if let Some(output) = outputs.iter().find(|output| output.name != PLAN || !output.parameters.is_empty()) {
        let got = format!("{} with {} parameters", output.name, output.parameters.len());
        return Err(Error::invalid("outputs", format!("{PLAN} with 0 parameters"), got));
    }

    let mut tensors = tensors(inputs, raw_input_contents)?;
    let mut observed = |name| {
        let tensor = tensors.remove(name).ok_or_else(|| Error::invalid("", "a tensor", "none"));
        tensor.and_then(observation).map_err(|e| e.within(name))
    };
    let (observation, goal) = (observed(OBSERVATION)?, observed(GOAL)?);
    let goal = match goal {
        Observation::Image(image) => Goal::Image(image),
        Observation::Position(position) => Goal::Position(position),
    };
    let steps_left = tensors.remove(STEPS_LEFT).map(steps_left).transpose().map_err(|e| e.within(STEPS_LEFT))?;
    if let Some(name) = tensors.into_keys().next() {
        return Err(Error::invalid("inputs", [OBSERVATION, GOAL, STEPS_LEFT].join(", "), name));
    }

    let mut number = |name: &str, most| {
        let number = parameters.remove(name).map(|value| integer(value, most)).transpose();
        number.map_err(|e| e.within(&format!("parameters.{name}")))
    };
    let seed = number("seed", u64::MAX)?.unwrap_or_default();
    let updates = number("updates", MAX_ITERATIONS.into())?.map(|updates| updates as u32);
    // The longest is that of `PlanRequest.deadline_ms`.
    let timeout_micros = number("timeout", u64::from(u32::MAX) * 1000)?.filter(|micros| *micros > 0);
    // Triton's own parameters are of streams, and its clients set them for all requests.
    if let Some(name) = parameters.into_keys().find(|name| !name.starts_with("triton_")) {
        return Err(Error::invalid("parameters", "seed, updates, timeout", name));
    }

    let gradient = Search { solver: Solver::Gradient, iterations: updates, samples: None, anytime: false };
    Ok(PlanRequest {
        seed,
        deadline: timeout_micros.map(|micros| Duration::from_millis(micros.div_ceil(1000))),
        model_digest: Some(model_version).filter(|version| !version.is_empty()),
        search: updates.is_some().then_some(gradient),
        steps_left,
        ..PlanRequest::new(model_name, goal, observation)
    })
}

/// Input tensor.
struct Tensor {
    datatype: String,
    shape: Vec<i64>,
    /// Elements in C order, little-endian.
    data: Vec<u8>,
}

impl Tensor {
    fn is(&self, datatype: &str, shape: &[i64]) -> bool {
        self.datatype == datatype && self.shape == shape
    }
}

impl fmt::Display for Tensor {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {:?}", self.datatype, self.shape)
    }
}

/// Input tensors by name, from raw or typed contents.
fn tensors(inputs: Vec<InferInputTensor>, raw: Vec<Vec<u8>>) -> Result<BTreeMap<String, Tensor>, Error> {
    if !raw.is_empty() && raw.len() != inputs.len() {
        return Err(Error::invalid("raw_input_contents", format!("as many as inputs, {}", inputs.len()), raw.len()));
    }

    let (mut raw, mut tensors) = (raw.into_iter(), BTreeMap::new());
    for (at, InferInputTensor { name, datatype, shape, contents }) in inputs.into_iter().enumerate() {
        let data = match (raw.next(), contents) {
            (Some(data), None) => Ok(data),
            (None, Some(contents)) => typed(&datatype, *contents),
            (Some(_), Some(_)) => Err(Error::invalid("", "none beside raw_input_contents", "some")),
            (None, None) => Err(Error::invalid("", "a value, or raw_input_contents", "none")),
        };
        let data = data.map_err(|e| e.within(&format!("inputs[{at}].contents")))?;
        if tensors.contains_key(&name) {
            return Err(Error::invalid("inputs", "each name once", format!("{name} twice")));
        }
        tensors.insert(name, Tensor { datatype, shape, data });
    }
    Ok(tensors)
}

/// Typed contents as raw ones; none for a datatype that no input has.
fn typed(datatype: &str, contents: InferTensorContents) -> Result<Vec<u8>, Error> {
    let byte = |value| u8::try_from(value).map_err(|_| Error::invalid("uint_contents", "0 to 255", value));
    match datatype {
        UINT8 => contents.uint_contents.into_iter().map(byte).collect(),
        FP32 => Ok(contents.fp32_contents.into_iter().flat_map(f32::to_le_bytes).collect()),
        INT32 => Ok(contents.int_contents.into_iter().flat_map(i32::to_le_bytes).collect()),
        _ => Ok(Vec::new()),
    }
}

/// Decodes an image or a position.
fn observation(tensor: Tensor) -> Result<Observation, Error> {
    if tensor.is(UINT8, &IMAGE) {
        let [height, width, _] = IMAGE.map(|side| side as u32);
        return Ok(Image::new(height, width, tensor.data)?.into());
    }
    if tensor.is(FP32, &POSITION) {
        return Ok(Position::new(elements(&tensor.data)?.map(f32::from_le_bytes))?.into());
    }
    Err(Error::invalid("", format!("{UINT8} {IMAGE:?} or {FP32} {POSITION:?}"), tensor))
}

fn steps_left(tensor: Tensor) -> Result<u32, Error> {
    if !tensor.is(INT32, &SCALAR) {
        return Err(Error::invalid("", format!("{INT32} {SCALAR:?}"), tensor));
    }
    let [steps] = elements(&tensor.data)?.map(i32::from_le_bytes);
    let valid = u32::try_from(steps).ok().filter(|steps| (1..=MAX_STEPS_LEFT).contains(steps));
    valid.ok_or_else(|| Error::invalid("", format!("1 to {MAX_STEPS_LEFT}"), steps))
}

/// Elements of four bytes each.
fn elements<const N: usize>(data: &[u8]) -> Result<[[u8; 4]; N], Error> {
    let (elements, rest) = data.as_chunks::<4>();
    match elements.try_into() {
        Ok(elements) if rest.is_empty() => Ok(elements),
        _ => Err(Error::invalid("data", format!("{} bytes", 4 * N), format!("{} bytes", data.len()))),
    }
}

/// Integer parameter, from 0 to `most`.
fn integer(parameter: InferParameter, most: u64) -> Result<u64, Error> {
    let expected = format!("an integer from 0 to {most}");
    let value: i128 = match parameter.parameter_choice {
        Some(ParameterChoice::Int64Param(value)) => value.into(),
        Some(ParameterChoice::Uint64Param(value)) => value.into(),
        other => return Err(Error::invalid("", expected, format!("{other:?}"))),
    };
    let valid = u64::try_from(value).ok().filter(|value| *value <= most);
    valid.ok_or_else(|| Error::invalid("", expected, value))
}

fn response(model_name: String, id: String, plan: PlanResponse) -> ModelInferResponse {
    let PlanResponse { actions, times, model_digest, .. } = plan;
    let shape = [actions.len(), actions.first().map_or(0, Vec::len)].map(|side| side as i64);
    let seconds = |value| InferParameter { parameter_choice: Some(ParameterChoice::DoubleParam(value)) };
    let parameters = [
        ("queue_seconds".into(), seconds(times.queue_seconds)),
        ("encode_seconds".into(), seconds(times.encode_seconds)),
        ("plan_seconds".into(), seconds(times.plan_seconds)),
    ];
    ModelInferResponse {
        model_name,
        model_version: model_digest,
        id,
        parameters: parameters.into(),
        outputs: vec![InferOutputTensor { name: PLAN.into(), datatype: FP32.into(), shape: shape.into() }],
        raw_output_contents: vec![actions.into_iter().flatten().flat_map(f32::to_le_bytes).collect()],
    }
}

/// Translates the field name of a planner's error to that of this protocol.
fn renamed(mut error: Error) -> Error {
    let (field, rest) = error.field.split_once('.').unwrap_or((&error.field, ""));
    let name = match field {
        "model" => "model_name",
        "model_digest" => "model_version",
        "position" => OBSERVATION,
        "goal_image" | "goal_position" => GOAL,
        "search" => "parameters.updates",
        "deadline_ms" => "parameters.timeout",
        _ => return error,
    };
    error.field = rest.to_owned();
    error.within(name)
}
