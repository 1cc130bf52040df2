//! Transport of openpi's protocol: the answers of the core, and connections that outlive invalid requests.

use crate::common::{
    self, Fixture, Gate, PATIENCE, checkpoint, image, method, plan_request, position_checkpoint, position_request, soon,
};
use cpn::{Method, MethodKind, Plan};
use futures::{SinkExt, StreamExt};
use planner::model::RANDOM;
use rmpv::Value;
use std::net::SocketAddr;
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;
use tokio_tungstenite::tungstenite::protocol::frame::coding::CloseCode;
use tokio_tungstenite::tungstenite::{Error as SocketError, Message};
use tokio_tungstenite::{WebSocketStream, client_async};
use wire::planner::PlanResponse;

/// Maximum number of clients.
const MAX_CONNECTIONS: usize = 64;

async fn start(checkpoints: &[(&str, Vec<u8>)]) -> Fixture {
    Fixture::start(checkpoints, |config| config.openpi_listen = Some(([127, 0, 0, 1], 0).into())).await
}

/// Client that has read the metadata.
struct Client {
    socket: WebSocketStream<TcpStream>,
    metadata: Value,
}

impl Client {
    async fn connect(address: SocketAddr) -> Result<Self, SocketError> {
        let stream = TcpStream::connect(address).await?;
        let (mut socket, _) = client_async(format!("ws://{address}"), stream).await?;
        let metadata = unpacked(&soon(socket.next()).await.unwrap()?.into_data());
        Ok(Self { socket, metadata })
    }

    async fn of(fixture: &Fixture) -> Self {
        Self::connect(fixture.planner.openpi_address().unwrap()).await.unwrap()
    }

    async fn send(&mut self, message: Message) {
        self.socket.send(message).await.unwrap();
    }

    async fn receive(&mut self) -> Message {
        soon(self.socket.next()).await.unwrap().unwrap()
    }

    /// Sends a request; returns the plan, or the text of an error.
    async fn infer(&mut self, message: impl Into<Message>) -> Result<Value, String> {
        self.send(message.into()).await;
        match self.receive().await {
            Message::Binary(bytes) => Ok(unpacked(&bytes)),
            Message::Text(text) => Err(text.to_string()),
            other => panic!("expected an answer, got {other:?}"),
        }
    }
}

fn unpacked(mut bytes: &[u8]) -> Value {
    let value = rmpv::decode::read_value(&mut bytes).unwrap();
    assert!(bytes.is_empty());
    value
}

fn packed(fields: &[(&str, Value)]) -> Vec<u8> {
    let pairs = fields.iter().map(|(name, value)| ((*name).into(), value.clone())).collect();
    let mut bytes = Vec::new();
    rmpv::encode::write_value(&mut bytes, &Value::Map(pairs)).unwrap();
    bytes
}

fn array(dtype: &str, shape: &[u32], data: impl Into<Vec<u8>>) -> Value {
    let key = |name: &str| Value::from(name.as_bytes());
    Value::Map(vec![
        (key("__ndarray__"), true.into()),
        (key("data"), data.into().into()),
        (key("dtype"), dtype.into()),
        (key("shape"), shape.iter().map(|side| Value::from(*side)).collect::<Vec<_>>().into()),
    ])
}

fn picture(seed: u64) -> Value {
    array("|u1", &[84, 84, 3], image(seed).data)
}

fn position([x, y, z]: [f32; 3]) -> Value {
    array("<f4", &[3], [x.to_le_bytes(), y.to_le_bytes(), z.to_le_bytes()].concat())
}

/// Fields of the request equivalent to [`plan_request`].
fn request(model: &str, seed: u64) -> [(&str, Value); 5] {
    [
        ("observation/image", picture(seed)),
        ("goal/image", picture(0)),
        ("model", model.into()),
        ("seed", seed.into()),
        ("steps_left", 40.into()),
    ]
}

fn field<'a>(value: &'a Value, name: &str) -> &'a Value {
    let pairs = value.as_map().unwrap();
    let of_name = |key: &Value| key.as_str() == Some(name) || key.as_slice() == Some(name.as_bytes());
    &pairs.iter().find(|(key, _)| of_name(key)).unwrap_or_else(|| panic!("no {name} in {value}")).1
}

fn keys(value: &Value) -> Vec<&str> {
    value.as_map().unwrap().iter().map(|(key, _)| key.as_str().unwrap()).collect()
}

/// Asserts that an answer over openpi is the core's, bit for bit, with the actions clipped.
fn assert_same(answer: &Value, plan: &PlanResponse) {
    let actions = field(answer, "actions");
    assert_eq!(*field(actions, "__ndarray__"), true.into());
    assert_eq!(field(actions, "dtype").as_str(), Some("<f4"));
    let shape = [plan.actions.len(), plan.actions[0].len()].map(Value::from);
    assert_eq!(field(actions, "shape").as_array().unwrap()[..], shape);
    let clipped = plan.actions.iter().flatten().flat_map(|v| v.clamp(-1.0, 1.0).to_le_bytes());
    assert_eq!(field(actions, "data").as_slice().unwrap(), clipped.collect::<Vec<_>>());
    assert_eq!(field(answer, "model_digest").as_str(), Some(&*plan.model_digest));
    assert_eq!(field(answer, "goal_id").as_str(), Some(&*plan.goal_id));
    assert_eq!(*field(answer, "latent_distance"), plan.latent_distance.map_or(Value::Nil, Value::from));
    for (timing, names) in
        [("server_timing", &["infer_ms", "queue_ms"][..]), ("policy_timing", &["infer_ms", "encode_ms", "plan_ms"])]
    {
        let timing = field(answer, timing);
        assert_eq!(keys(timing), names);
        assert!(names.iter().all(|name| field(timing, name).as_f64().unwrap() > 0.0), "{timing}");
    }
}

/// Method with actions out of bounds.
fn far() -> Box<dyn Method> {
    let plan = || Plan { actions: vec![vec![0.5, -0.5, 7.0, -7.0]; 2], inner_losses: Vec::new(), iterations: 0 };
    method(move |queries| queries.iter().map(|_| plan()).collect())
}

#[tokio::test(flavor = "multi_thread")]
async fn openpi_gets_the_answers_of_the_core() {
    let mut checkpoints: Vec<_> = MethodKind::ALL.map(|method| (method.name(), checkpoint(method, 1))).into();
    checkpoints.push(("jenga", position_checkpoint(1)));
    let fixture = start(&checkpoints).await;
    common::serve(&fixture.planner.core(), "far", far()).await;
    let [core, ..] = fixture.clients();
    let mut client = Client::of(&fixture).await;

    for model in ["bc", "cpn", "far", RANDOM, "te-bc", "te-bc-horizon", "upn"] {
        let plan = core.plan(plan_request(model, 3)).await.unwrap();
        let by_image = client.infer(packed(&request(model, 3))).await.unwrap();
        assert_same(&by_image, &plan);
        let by_id = [("observation/image", picture(3)), ("goal/id", plan.goal_id.as_str().into()), ("seed", 3.into())];
        let others = [("model", model.into()), ("steps_left", 40.into()), ("prompt", "".into())];
        let by_id = [&by_id[..], &others].concat();
        assert_same(&client.infer(packed(&by_id)).await.unwrap(), &plan);
    }
    let far = client.infer(packed(&request("far", 3))).await.unwrap();
    let clipped = [0.5_f32, -0.5, 1.0, -1.0].map(f32::to_le_bytes).concat();
    assert_eq!(field(field(&far, "actions"), "data").as_slice().unwrap(), clipped.repeat(2));

    let plan = core.plan(position_request("jenga")).await.unwrap();
    let between_positions = [
        ("observation/position", position([0.5, 0.1, 0.2])),
        ("goal/position", position([0.73, -0.09, 0.18])),
        ("model", "jenga".into()),
    ];
    assert_same(&client.infer(packed(&between_positions)).await.unwrap(), &plan);

    let models = field(&client.metadata, "models");
    assert_eq!(keys(models), ["bc", "cpn", "far", "jenga", RANDOM, "te-bc", "te-bc-horizon", "upn"]);
    assert_eq!(field(field(models, "cpn"), "horizon").as_u64(), Some(5));
    assert_eq!(field(field(models, "jenga"), "digest").as_str(), Some(&*plan.model_digest));
    assert_eq!(field(&client.metadata, "image_shape").as_array().unwrap()[..], [84, 84, 3].map(Value::from));
    fixture.planner.shutdown().await.unwrap();
}

/// Numpy scalar, as openpi's client packs it.
fn generic(dtype: &str, data: impl Into<Value>) -> Value {
    let key = |name: &str| Value::from(name.as_bytes());
    Value::Map(vec![(key("__npgeneric__"), true.into()), (key("data"), data.into()), (key("dtype"), dtype.into())])
}

/// All Python and numpy forms of numbers, text and None.
#[tokio::test(flavor = "multi_thread")]
async fn scalars_of_all_forms_are_accepted() {
    let fixture = start(&[("cpn", checkpoint(MethodKind::Cpn, 1))]).await;
    let [core, ..] = fixture.clients();
    let mut client = Client::of(&fixture).await;
    let plan = core.plan(plan_request(RANDOM, 3)).await.unwrap();
    let wide = |text: &str| text.chars().flat_map(|letter| (letter as u32).to_le_bytes()).collect::<Vec<_>>();
    let seeds = [
        generic("<i8", 3),
        generic("|u1", 3),
        array("<i8", &[], 3_i64.to_le_bytes()),
        array("<u4", &[], 3_u32.to_le_bytes()),
        array("|i1", &[], [3]),
    ];
    let models = [
        Value::Binary(RANDOM.into()),
        generic("<U6", RANDOM),
        array("<U6", &[], wide(RANDOM)),
        array("|S8", &[], *b"random\0\0"),
    ];
    let prompts = [Value::Nil, Value::Binary(Vec::new()), generic("<U0", ""), array("<U1", &[], wide("\0"))];
    for (at, seed) in seeds.into_iter().enumerate() {
        let (model, prompt) = (models[at % models.len()].clone(), prompts[at % prompts.len()].clone());
        let fields = [
            ("observation/image", picture(3)),
            ("goal/image", picture(0)),
            ("goal/id", Value::Nil),
            ("model", model),
            ("seed", seed),
            ("prompt", prompt),
        ];
        assert_same(&client.infer(packed(&fields)).await.unwrap_or_else(|e| panic!("{at}: {e}")), &plan);
    }
    let id = Value::Binary(plan.goal_id.clone().into());
    let fields = [("observation/image", picture(3)), ("goal/id", id), ("model", RANDOM.into()), ("seed", 3.into())];
    assert_same(&client.infer(packed(&fields)).await.unwrap(), &plan);

    for (field, value, expected) in [
        ("seed", generic("<i8", -3), "seed: expected an integer from 0"),
        ("seed", generic("<f8", 3.5), "seed: expected an integer from 0"),
        ("seed", array("<i8", &[1], 3_i64.to_le_bytes()), "seed: expected an integer from 0"),
        ("seed", array("<i4", &[], (-3_i32).to_le_bytes()), "seed: expected an integer from 0"),
        ("seed", array("<i8", &[], [0; 9]), "seed: expected an integer from 0"),
        ("model", Value::Binary(vec![0xff]), "model: expected text, got 1 bytes"),
        ("model", array("<U1", &[], [0, 0, 0, 0xff]), "model: expected text"),
        ("prompt", generic("<U4", "push"), "prompt: expected none"),
        ("prompt", Value::Binary(b"push".into()), "prompt: expected none"),
    ] {
        let refused = client.infer(spoiled(field, value)).await.unwrap_err();
        assert!(refused.starts_with(expected), "{refused}");
    }
}

/// Response to an HTTP client.
async fn http(address: SocketAddr, request: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = String::new();
    soon(stream.read_to_string(&mut answer)).await.unwrap();
    answer
}

#[tokio::test(flavor = "multi_thread")]
async fn health_checks_are_answered_as_by_openpis_server() {
    let fixture = start(&[]).await;
    let address = fixture.planner.openpi_address().unwrap();
    let well = http(address, "GET /healthz HTTP/1.1\r\nHost: planner\r\n\r\n").await;
    assert!(well.starts_with("HTTP/1.1 200 OK\r\n") && well.ends_with("\r\n\r\nOK\n"), "{well}");
    let refused = http(address, "GET / HTTP/1.1\r\nHost: planner\r\n\r\n").await;
    assert!(refused.starts_with("HTTP/1.1 400 Bad Request\r\n"), "{refused}");
    // An endless head is read up to its limit.
    let mut stream = TcpStream::connect(address).await.unwrap();
    let endless = format!("GET /{} HTTP/1.1\r\n", "x".repeat(32 << 10));
    let _ = stream.write_all(endless.as_bytes()).await;
    let _ = soon(stream.read_to_end(&mut Vec::new())).await;
    Client::of(&fixture).await.infer(packed(&request(RANDOM, 1))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn the_only_model_need_not_be_named() {
    let fixture = start(&[("cpn", checkpoint(MethodKind::Cpn, 1))]).await;
    let plan = fixture.clients()[0].plan(plan_request("cpn", 0)).await.unwrap();
    let answer = Client::of(&fixture).await.infer(packed(&request("", 0)[..2])).await.unwrap();
    assert_same(&answer, &plan);
}

/// Fields of a valid request, with one changed, added or, with nil, left out.
fn spoiled(name: &'static str, value: Value) -> Vec<u8> {
    let mut fields = request("cpn", 3).to_vec();
    fields.retain(|(field, _)| *field != name);
    if !value.is_nil() {
        fields.push((name, value));
    }
    packed(&fields)
}

#[tokio::test(flavor = "multi_thread")]
async fn invalid_requests_are_refused_and_the_next_is_answered() {
    let checkpoints = [
        ("bc", checkpoint(MethodKind::Bc, 1)),
        ("cpn", checkpoint(MethodKind::Cpn, 1)),
        ("jenga", position_checkpoint(1)),
    ];
    let fixture = start(&checkpoints).await;
    let mut client = Client::of(&fixture).await;
    let unregistered = "0".repeat(64);
    let floats = array("<f4", &[84, 84, 3], vec![0; 84 * 84 * 12]);
    let observations = "one of observation/image, observation/position";
    let goals = "one of goal/image, goal/position, goal/id";
    let cases = [
        ("observation/image", Value::Nil, format!("observation: expected {observations}, got none")),
        (
            "observation/position",
            position([0.0; 3]),
            format!("observation: expected {observations}, got observation/image and observation/position"),
        ),
        ("goal/image", Value::Nil, format!("goal: expected {goals}, got none")),
        ("goal/id", "x".into(), format!("goal: expected {goals}, got goal/image and goal/id")),
        (
            "observation/image",
            floats,
            "observation/image: expected dtype |u1 (uint8), shape [height, width, 3], got dtype <f4, shape [84, 84, 3], \
             84672 bytes"
                .into(),
        ),
        (
            "observation/image",
            array("|u1", &[1, 84, 84, 3], vec![0; 84 * 84 * 3]),
            "observation/image: expected dtype |u1 (uint8), shape [height, width, 3], got dtype |u1, \
             shape [1, 84, 84, 3], 21168 bytes"
                .into(),
        ),
        (
            "observation/image",
            array("|u1", &[224, 224, 3], vec![0; 224 * 224 * 3]),
            "observation/image.height: expected 84, got 224".into(),
        ),
        (
            "goal/image",
            array("|u1", &[84, 84, 3], vec![0; 10]),
            "goal/image.data: expected 21168 bytes, got 10 bytes".into(),
        ),
        (
            "goal/image",
            array("|u1", &[u32::MAX, u32::MAX, 3], vec![0; 10]),
            "goal/image.height: expected 1 to 512 pixels, got 4294967295".into(),
        ),
        ("goal/image", "a picture".into(), "goal/image: expected a numpy array, got \"a picture\"".into()),
        ("goal/image", image(0).data.into(), "goal/image: expected a numpy array, got 21168 bytes".into()),
        ("seed", vec![Value::from(1)].into(), "seed: expected an integer from 0 to 2^64 - 1, got a list of 1".into()),
        (
            "goal/image",
            Value::Map(vec![(Value::from(&b"__ndarray__"[..]), true.into())]),
            "goal/image: expected a numpy array, got a map without dtype, shape and data of one".into(),
        ),
        (
            "model",
            Value::Nil,
            "model: expected one of bc, cpn, jenga, got none".into(),
        ),
        ("model", "gpt".into(), "model: expected one of bc, cpn, jenga, random, got gpt".into()),
        ("model", 7.into(), "model: expected text, got 7".into()),
        ("model", "jenga".into(), "goal/image: expected a position, got an image".into()),
        ("seed", (-1).into(), "seed: expected an integer from 0 to 2^64 - 1, got -1".into()),
        ("steps_left", 0.into(), "steps_left: expected an integer from 1 to 10000, got 0".into()),
        ("steps_left", 10_001.into(), "steps_left: expected an integer from 1 to 10000, got 10001".into()),
        (
            "prompt",
            "close the drawer".into(),
            "prompt: expected none: the goal is a picture or a position, got \"close the drawer\"".into(),
        ),
        (
            "observation/state",
            position([0.0; 3]),
            "payload: expected fields among observation/image, observation/position, goal/image, goal/position, goal/id, \
             model, seed, steps_left, prompt, got observation/state"
                .into(),
        ),
    ];
    for (name, value, error) in cases {
        assert_eq!(client.infer(spoiled(name, value)).await.unwrap_err(), error);
        client.infer(packed(&request("cpn", 3))).await.unwrap();
    }
    let by_id = [("observation/image", picture(3)), ("goal/id", unregistered.as_str().into()), ("model", "cpn".into())];
    let error = format!("goal/id: expected one of the 1024 goals registered last, got {unregistered}");
    assert_eq!(client.infer(packed(&by_id)).await.unwrap_err(), error);
    for (hand, error) in [
        (position([f32::NAN, 0.0, 0.0]), "observation/position.x: expected -1000 to 1000 metres, got NaN"),
        (
            array("<f8", &[3], vec![0; 24]),
            "observation/position: expected dtype <f4 (float32), shape [3], 12 bytes, got dtype <f8, shape [3], 24 bytes",
        ),
        (
            array("<f4", &[3], vec![0; 13]),
            "observation/position: expected dtype <f4 (float32), shape [3], 12 bytes, got dtype <f4, shape [3], 13 bytes",
        ),
    ] {
        let fields = [("observation/position", hand), ("goal/image", picture(0)), ("model", "jenga".into())];
        assert_eq!(client.infer(packed(&fields)).await.unwrap_err(), error);
    }
}

/// Malformed messages are refused, and the connection stays usable.
#[tokio::test(flavor = "multi_thread")]
async fn malformed_messages_are_refused() {
    let fixture = start(&[]).await;
    let mut client = Client::of(&fixture).await;
    let valid = packed(&request(RANDOM, 3));
    let huge = |marker: u8| vec![marker, 0xff, 0xff, 0xff, 0xff];
    let cases = [
        ("nothing", Vec::new()),
        ("truncated", valid[..valid.len() / 2].to_vec()),
        ("more than one", [&valid[..], &valid[..]].concat()),
        ("no map", vec![0x01]),
        ("a key that is no text", vec![0x81, 0x01, 0x01]),
        ("a key that is no UTF-8", vec![0x81, 0xa1, 0xff, 0x01]),
        ("four billion bytes", huge(0xc6)),
        ("four billion values", huge(0xdd)),
        ("four billion fields", huge(0xdf)),
        ("nested without end", vec![0x91; 1 << 20]),
        ("a million small values", [&[0xdd, 0, 0x0f, 0xff, 0xfb][..], &[0xc0; (1 << 20) - 5]].concat()),
    ];
    for (what, bytes) in cases {
        let error = client.infer(bytes).await.unwrap_err();
        assert!(error.starts_with("payload: expected one msgpack map with text for keys, got "), "{what}: {error}");
        assert!(error.len() < 1000, "{what}");
        client.infer(valid.clone()).await.unwrap();
    }
    let error = client.infer(Message::text("{}")).await.unwrap_err();
    assert_eq!(error, "payload: expected a binary frame, got a text frame");
    client.infer(valid).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn a_message_that_is_too_large_ends_its_connection_with_the_reason() {
    let fixture = start(&[]).await;
    let mut client = Client::of(&fixture).await;
    let error = client.infer(vec![0; (1 << 20) + 1]).await.unwrap_err();
    assert_eq!(error, "payload: expected at most 1048576 bytes, got 1048577 bytes");
    let Message::Close(Some(frame)) = client.receive().await else { panic!("expected a close frame") };
    assert_eq!(frame.code, CloseCode::Size);
    Client::of(&fixture).await.infer(packed(&request(RANDOM, 3))).await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn clients_without_websocket_or_that_leave_midway_do_not_disturb_others() {
    let fixture = start(&[]).await;
    let address = fixture.planner.openpi_address().unwrap();
    let mut client = Client::of(&fixture).await;
    for bytes in [&b"GET / HTTP/1.1\r\nHost: x\r\n\r\n"[..], &[0xff; 100_000]] {
        let mut stream = TcpStream::connect(address).await.unwrap();
        // The planner may close the connection before it has read everything.
        let _ = stream.write_all(bytes).await;
        let mut answer = Vec::new();
        let _ = soon(stream.read_to_end(&mut answer)).await;
        client.infer(packed(&request(RANDOM, 3))).await.unwrap();
    }
    let mut leaving = Client::of(&fixture).await;
    leaving.send(packed(&request(RANDOM, 3)).into()).await;
    drop(leaving);
    let mut midway = Client::of(&fixture).await;
    // Begin of a masked binary frame of 64 bytes.
    midway.socket.get_mut().write_all(&[0x82, 0x80 | 64, 1, 2, 3, 4, 5]).await.unwrap();
    drop(midway);
    client.infer(packed(&request(RANDOM, 3))).await.unwrap();
    fixture.planner.shutdown().await.unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn connections_are_bounded_and_places_are_freed() {
    let fixture = start(&[]).await;
    let address = fixture.planner.openpi_address().unwrap();
    let mut clients = Vec::new();
    for _ in 0..MAX_CONNECTIONS {
        clients.push(Client::connect(address).await.unwrap());
    }
    let Err(SocketError::Http(response)) = Client::connect(address).await else { panic!("expected a refusal") };
    assert_eq!(response.status(), 503);
    clients[0].infer(packed(&request(RANDOM, 3))).await.unwrap();
    drop(clients.pop());
    let again = async {
        loop {
            match Client::connect(address).await {
                Err(SocketError::Http(_)) => tokio::time::sleep(PATIENCE / 1000).await,
                result => return result,
            }
        }
    };
    soon(again).await.unwrap().infer(packed(&request(RANDOM, 3))).await.unwrap();
}

/// A plan in progress at shutdown is finished and sent, and every client gets a close frame.
#[tokio::test(flavor = "multi_thread")]
async fn shutdown_lets_a_plan_finish_and_closes_connections() {
    let fixture = start(&[]).await;
    let gate = Gate::serve(&fixture.planner.core()).await;
    let (mut planning, mut idle) = (Client::of(&fixture).await, Client::of(&fixture).await);
    planning.send(packed(&request("gated", 1)).into()).await;
    assert_eq!(gate.entered().await, 1);
    let shutdown = tokio::spawn(fixture.planner.shutdown());
    let Message::Close(Some(frame)) = idle.receive().await else { panic!("expected a close frame") };
    assert_eq!(frame.code, CloseCode::Away);
    drop(idle);
    gate.open();
    let Message::Binary(answer) = planning.receive().await else { panic!("expected an answer") };
    assert_eq!(field(field(&unpacked(&answer), "actions"), "shape").as_array().unwrap()[0], 1.into());
    assert!(matches!(planning.receive().await, Message::Close(Some(_))));
    drop(planning);
    soon(shutdown).await.unwrap().unwrap();
}

#[tokio::test(flavor = "multi_thread")]
async fn openpi_is_off_unless_asked_for() {
    let fixture = Fixture::start(&[], |_| ()).await;
    assert_eq!(fixture.planner.openpi_address(), None);
}
