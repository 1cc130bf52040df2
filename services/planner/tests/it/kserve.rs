//! Transport of the Open Inference Protocol: the answers of the planner service, and refusals that name the field.

use crate::common::{
    Fixture, Gate, checkpoint, from_bytes, image, plan_request, position_checkpoint, position_request, soon,
};
use cpn::MethodKind;
use planner::model::RANDOM;
use wire::inference::grpc_inference_service_client::GrpcInferenceServiceClient;
use wire::inference::infer_parameter::ParameterChoice;
use wire::inference::model_infer_request::{InferInputTensor, InferRequestedOutputTensor};
use wire::inference::model_metadata_response::TensorMetadata;
use wire::inference::{
    InferParameter, InferTensorContents, ModelConfigRequest, ModelInferRequest, ModelInferResponse,
    ModelMetadataRequest, ModelMetadataResponse, ModelReadyRequest, ServerLiveRequest, ServerMetadataRequest,
    ServerReadyRequest,
};
use wire::planner::PlanResponse;
use wire::{Code, Error, proto};

type Client = GrpcInferenceServiceClient<tonic::transport::Channel>;

async fn start() -> (Fixture, Client) {
    let mut checkpoints: Vec<_> = MethodKind::ALL.map(|method| (method.name(), checkpoint(method, 1))).into();
    checkpoints.push(("jenga", position_checkpoint(1)));
    let fixture = Fixture::start(&checkpoints, |_| ()).await;
    let client = Client::new(fixture.channel.clone());
    (fixture, client)
}

async fn infer(client: &Client, request: ModelInferRequest) -> Result<ModelInferResponse, Error> {
    Ok(soon(client.clone().model_infer(request)).await?.into_inner())
}

async fn metadata(client: &Client, name: &str, version: &str) -> Result<ModelMetadataResponse, Error> {
    let request = ModelMetadataRequest { name: name.into(), version: version.into() };
    Ok(client.clone().model_metadata(request).await?.into_inner())
}

fn tensor(name: &str, datatype: &str, shape: &[i64]) -> InferInputTensor {
    InferInputTensor { name: name.into(), datatype: datatype.into(), shape: shape.into(), contents: None }
}

fn parameter(choice: ParameterChoice) -> InferParameter {
    InferParameter { parameter_choice: Some(choice) }
}

fn set(request: &mut ModelInferRequest, name: &str, choice: ParameterChoice) {
    request.parameters.insert(name.into(), parameter(choice));
}

/// Request equivalent to [`plan_request`].
pub(crate) fn request(model: &str, seed: i64) -> ModelInferRequest {
    ModelInferRequest {
        model_name: model.into(),
        parameters: [("seed".into(), parameter(ParameterChoice::Int64Param(seed)))].into(),
        inputs: vec![
            tensor("observation", "UINT8", &[84, 84, 3]),
            tensor("goal", "UINT8", &[84, 84, 3]),
            tensor("steps_left", "INT32", &[1]),
        ],
        raw_input_contents: vec![image(seed as u64).data, image(0).data, 40_i32.to_le_bytes().into()],
        ..Default::default()
    }
}

/// Request equivalent to [`position_request`].
fn between_positions(model: &str) -> ModelInferRequest {
    ModelInferRequest {
        model_name: model.into(),
        inputs: vec![tensor("observation", "FP32", &[3]), tensor("goal", "FP32", &[3])],
        raw_input_contents: [[0.5_f32, 0.1, 0.2], [0.73, -0.09, 0.18]].map(|p| p.map(f32::to_le_bytes).concat()).into(),
        ..Default::default()
    }
}

/// The same request with typed contents.
fn typed(mut request: ModelInferRequest) -> ModelInferRequest {
    for (input, raw) in request.inputs.iter_mut().zip(std::mem::take(&mut request.raw_input_contents)) {
        let words = raw.as_chunks().0;
        let mut contents = InferTensorContents::default();
        match input.datatype.as_str() {
            "UINT8" => contents.uint_contents = raw.iter().copied().map(u32::from).collect(),
            "INT32" => contents.int_contents = words.iter().copied().map(i32::from_le_bytes).collect(),
            _ => contents.fp32_contents = words.iter().copied().map(f32::from_le_bytes).collect(),
        }
        input.contents = Some(Box::new(contents));
    }
    request
}

/// Asserts that an answer has the plan, bit for bit.
fn assert_same(answer: &ModelInferResponse, plan: &PlanResponse) {
    let [output] = &answer.outputs[..] else { panic!("{:?}", answer.outputs) };
    assert_eq!((output.name.as_str(), output.datatype.as_str()), ("plan", "FP32"));
    assert_eq!(output.shape, [plan.actions.len(), plan.actions[0].len()].map(|side| side as i64));
    let elements: Vec<_> = plan.actions.iter().flatten().flat_map(|value| value.to_le_bytes()).collect();
    assert_eq!(answer.raw_output_contents, [elements]);
    assert_eq!(answer.model_version, plan.model_digest);
    assert_eq!(answer.parameters.keys().collect::<Vec<_>>(), ["encode_seconds", "plan_seconds", "queue_seconds"]);
    for (name, seconds) in &answer.parameters {
        assert!(matches!(seconds.parameter_choice, Some(ParameterChoice::DoubleParam(s)) if s > 0.0), "{name}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn plans_are_those_of_the_planner_service() {
    let (fixture, client) = start().await;
    let [_, grpc, _] = fixture.clients();
    for model in ["bc", "cpn", RANDOM, "te-bc", "te-bc-horizon", "upn"] {
        let plan = grpc.plan(plan_request(model, 3)).await.unwrap();
        assert_same(&infer(&client, request(model, 3)).await.unwrap(), &plan);
        assert_same(&infer(&client, typed(request(model, 3))).await.unwrap(), &plan);
    }
    for model in ["jenga", RANDOM] {
        let plan = grpc.plan(position_request(model)).await.unwrap();
        assert_same(&infer(&client, between_positions(model)).await.unwrap(), &plan);
        assert_same(&infer(&client, typed(between_positions(model))).await.unwrap(), &plan);
    }

    let solver = proto::Solver::Gradient.into();
    let search = Some(proto::Search { solver, iterations: Some(4), ..Default::default() });
    let longer = grpc.plan(proto::PlanRequest { search, ..plan_request("cpn", 3) }).await.unwrap();
    let mut by_all = request("cpn", 3);
    set(&mut by_all, "updates", ParameterChoice::Uint64Param(4));
    set(&mut by_all, "timeout", ParameterChoice::Int64Param(60_000_000));
    set(&mut by_all, "triton_enable_empty_final_response", ParameterChoice::BoolParam(true));
    by_all.model_version = longer.model_digest.clone();
    by_all.id = "seven".into();
    by_all.outputs = vec![InferRequestedOutputTensor { name: "plan".into(), ..Default::default() }];
    let answer = infer(&client, by_all).await.unwrap();
    assert_same(&answer, &longer);
    assert_eq!((answer.model_name.as_str(), answer.id.as_str()), ("cpn", "seven"));
    assert_eq!(longer.iterations_run, 4);
    fixture.planner.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_server_describes_itself_and_its_models() {
    let (fixture, mut client) = start().await;
    assert!(client.server_live(ServerLiveRequest {}).await.unwrap().into_inner().live);
    assert!(client.server_ready(ServerReadyRequest {}).await.unwrap().into_inner().ready);
    let server = client.server_metadata(ServerMetadataRequest {}).await.unwrap().into_inner();
    assert_eq!((server.name.as_str(), server.version.as_str()), ("planner", env!("CARGO_PKG_VERSION")));

    let told = |name: &str, datatype: &str, shape: &[i64]| TensorMetadata {
        name: name.into(),
        datatype: datatype.into(),
        shape: shape.into(),
    };
    let images = || ["observation", "goal"].map(|name| told(name, "UINT8", &[84, 84, 3])).to_vec();
    let positions = || ["observation", "goal"].map(|name| told(name, "FP32", &[3])).to_vec();
    let steps_left = [told("steps_left", "INT32", &[1])];
    for (model, inputs, plan) in [
        ("cpn", images(), [5, 4]),
        (RANDOM, images(), [1, 4]),
        ("te-bc-horizon", [&images()[..], &steps_left].concat(), [1, 4]),
        ("jenga", positions(), [5, 3]),
    ] {
        let found = metadata(&client, model, "").await.unwrap();
        assert_eq!((found.name.as_str(), found.platform.as_str()), (model, "cpn"));
        assert_eq!((found.inputs, found.outputs), (inputs, vec![told("plan", "FP32", &plan)]), "{model}");
        let config = client.model_config(ModelConfigRequest { name: model.into(), ..Default::default() }).await;
        assert_eq!(config.unwrap().into_inner().config.unwrap().name, model);
    }

    let [core, ..] = fixture.clients();
    let before = core.digest("cpn").await;
    let ready = async |name: &str, version: &str| {
        let request = ModelReadyRequest { name: name.into(), version: version.into() };
        client.clone().model_ready(request).await.unwrap().into_inner().ready
    };
    assert_eq!(metadata(&client, "cpn", &before).await.unwrap().versions, [before.as_str()]);
    assert!(ready("cpn", "").await && ready("cpn", &before).await && !ready("gpt", "").await);
    let unknown = metadata(&client, "gpt", "").await.unwrap_err();
    assert_eq!((unknown.code, unknown.field.as_str()), (Code::NotFound, "name"), "{unknown}");

    // A new checkpoint is the only version; plans by the one before are still given.
    core.load_model(from_bytes("cpn", checkpoint(MethodKind::Cpn, 2))).await.unwrap();
    let after = core.digest("cpn").await;
    assert!(ready("cpn", &after).await && !ready("cpn", &before).await);
    assert_eq!(metadata(&client, "cpn", "").await.unwrap().versions, [after.as_str()]);
    let old = metadata(&client, "cpn", &before).await.unwrap_err();
    assert_eq!(old, Error::new(Code::NotFound, "version", &after, &before));
    for (version, digest) in [("", &after), (&after, &after), (&before, &before)] {
        let request = ModelInferRequest { model_version: version.into(), ..request("cpn", 3) };
        assert_eq!(infer(&client, request).await.unwrap().model_version, *digest);
    }
}

/// Request with one fault.
fn spoiled(spoil: impl FnOnce(&mut ModelInferRequest)) -> ModelInferRequest {
    let mut request = request("cpn", 3);
    spoil(&mut request);
    request
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_requests_are_refused_and_the_next_is_answered() {
    use ParameterChoice::{BoolParam, Int64Param, StringParam, Uint64Param};
    let (_fixture, client) = start().await;
    let digest = "0".repeat(64);
    let observed = "UINT8 [84, 84, 3] or FP32 [3]";
    let cases = [
        (spoiled(|r| r.inputs.clear()), "raw_input_contents: expected as many as inputs, 0, got 3".into()),
        (
            spoiled(|r| (r.inputs, r.raw_input_contents) = Default::default()),
            "observation: expected a tensor, got none".into(),
        ),
        (spoiled(|r| r.inputs[1].name = "target".into()), "goal: expected a tensor, got none".into()),
        (
            spoiled(|r| r.inputs[2].name = "state".into()),
            "inputs: expected observation, goal, steps_left, got state".into(),
        ),
        (spoiled(|r| r.inputs[2].name = "goal".into()), "inputs: expected each name once, got goal twice".into()),
        (
            spoiled(|r| r.inputs[0].datatype = "FP32".into()),
            format!("observation: expected {observed}, got FP32 [84, 84, 3]"),
        ),
        (
            spoiled(|r| r.inputs[0].shape.insert(0, 1)),
            format!("observation: expected {observed}, got UINT8 [1, 84, 84, 3]"),
        ),
        (
            spoiled(|r| r.inputs[1].shape = vec![i64::MIN, i64::MAX]),
            format!("goal: expected {observed}, got UINT8 [-9223372036854775808, 9223372036854775807]"),
        ),
        (spoiled(|r| r.raw_input_contents[1].truncate(10)), "goal.data: expected 21168 bytes, got 10 bytes".into()),
        (
            spoiled(|r| drop(r.raw_input_contents.pop())),
            "raw_input_contents: expected as many as inputs, 3, got 2".into(),
        ),
        (
            spoiled(|r| r.raw_input_contents.clear()),
            "inputs[0].contents: expected a value, or raw_input_contents, got none".into(),
        ),
        (
            spoiled(|r| r.inputs[2].contents = Some(Box::default())),
            "inputs[2].contents: expected none beside raw_input_contents, got some".into(),
        ),
        (
            spoiled(|r| {
                *r = typed(r.clone());
                r.inputs[1].contents.as_mut().unwrap().uint_contents[7] = 256;
            }),
            "inputs[1].contents.uint_contents: expected 0 to 255, got 256".into(),
        ),
        (
            spoiled(|r| {
                *r = typed(r.clone());
                r.inputs[0].contents.as_mut().unwrap().uint_contents.pop();
            }),
            "observation.data: expected 21168 bytes, got 21167 bytes".into(),
        ),
        (
            spoiled(|r| r.raw_input_contents[2] = 0_i32.to_le_bytes().into()),
            "steps_left: expected 1 to 10000, got 0".into(),
        ),
        (spoiled(|r| r.inputs[2].shape.clear()), "steps_left: expected INT32 [1], got INT32 []".into()),
        (spoiled(|r| r.raw_input_contents[2].push(0)), "steps_left.data: expected 4 bytes, got 5 bytes".into()),
        (
            spoiled(|r| set(r, "seed", Int64Param(-1))),
            "parameters.seed: expected an integer from 0 to 18446744073709551615, got -1".into(),
        ),
        (
            spoiled(|r| set(r, "updates", Uint64Param(1001))),
            "parameters.updates: expected an integer from 0 to 1000, got 1001".into(),
        ),
        (
            spoiled(|r| set(r, "updates", StringParam("7".into()))),
            "parameters.updates: expected an integer from 0 to 1000, got Some(StringParam(\"7\"))".into(),
        ),
        (
            spoiled(|r| set(r, "timeout", Uint64Param(u64::MAX))),
            format!("parameters.timeout: expected an integer from 0 to 4294967295000, got {}", u64::MAX),
        ),
        (
            spoiled(|r| set(r, "sequence_start", BoolParam(true))),
            "parameters: expected seed, updates, timeout, got sequence_start".into(),
        ),
        (
            spoiled(|r| r.outputs = vec![InferRequestedOutputTensor { name: "value".into(), ..Default::default() }]),
            "outputs: expected plan with 0 parameters, got value with 0 parameters".into(),
        ),
        (
            spoiled(|r| {
                let parameters = [("classification".into(), parameter(Int64Param(1)))].into();
                r.outputs = vec![InferRequestedOutputTensor { name: "plan".into(), parameters }];
            }),
            "outputs: expected plan with 0 parameters, got plan with 1 parameters".into(),
        ),
        (between_positions("cpn"), "goal: expected an image, got a position".into()),
        (spoiled(|r| r.model_name = "jenga".into()), "goal: expected a position, got an image".into()),
        (
            ModelInferRequest {
                raw_input_contents: vec![[f32::NAN; 3].map(f32::to_le_bytes).concat(); 2],
                ..between_positions("jenga")
            },
            "observation.x: expected -1000 to 1000 metres, got NaN".into(),
        ),
        (
            spoiled(|r| {
                r.model_name = "bc".into();
                set(r, "updates", Int64Param(2));
            }),
            "parameters.updates: expected none for a method that does not plan, got bc".into(),
        ),
        (
            spoiled(|r| {
                r.model_name = "te-bc-horizon".into();
                r.inputs.truncate(2);
                r.raw_input_contents.truncate(2);
            }),
            "steps_left: expected the number of steps that remain for the task, got none".into(),
        ),
    ];
    for (request, message) in cases {
        let error = infer(&client, request).await.unwrap_err();
        assert_eq!((error.code, error.to_string()), (Code::InvalidArgument, message));
    }

    let unknown = infer(&client, spoiled(|r| r.model_name = "gpt".into())).await.unwrap_err();
    let models = "one of bc, cpn, jenga, random, te-bc, te-bc-horizon, upn";
    assert_eq!(unknown, Error::new(Code::NotFound, "model_name", models, "gpt"));
    let absent = infer(&client, spoiled(|r| r.model_version = digest)).await.unwrap_err();
    assert_eq!((absent.code, absent.field.as_str()), (Code::FailedPrecondition, "model_version"), "{absent}");
    infer(&client, request("cpn", 3)).await.unwrap();
}

/// A request waits for the model as any other: its timeout is the plan's deadline.
#[tokio::test(flavor = "multi_thread")]
async fn a_timeout_that_passes_in_the_queue_is_a_deadline() {
    let (fixture, client) = start().await;
    let gate = Gate::serve(&fixture.planner.core()).await;
    let running = tokio::spawn({
        let client = client.clone();
        async move { infer(&client, request("gated", 1)).await }
    });
    assert_eq!(gate.entered().await, 1);
    let mut hasty = request(RANDOM, 2);
    set(&mut hasty, "timeout", ParameterChoice::Int64Param(50_000));
    let error = infer(&client, hasty).await.unwrap_err();
    let late = Error::new(Code::DeadlineExceeded, "parameters.timeout", "an answer within 50 ms", "none");
    assert_eq!(error, late);
    gate.open();
    soon(running).await.unwrap().unwrap();
}
