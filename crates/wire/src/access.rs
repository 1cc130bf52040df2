//! Role-based access control: one table of all endpoints, and of the roles that may offer and use each.
//!
//! The access control of routers, gRPC, openpi and metrics is derived from it.

use crate::checkpoint::ListVersionsResponse;
use crate::planner::{ListModelsResponse, LoadModelRequest, PlanRequest};
use crate::training::ListRunsResponse;
use crate::{Error, Message, key};
use std::fmt;
use std::str::FromStr;
use zenoh::key_expr::OwnedKeyExpr;

/// Role of a process or person in the network.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Role {
    /// Planner service.
    Planner,
    /// Trainer service: demonstrations, training runs, checkpoints.
    Trainer,
    /// Simulator worker.
    Worker,
    /// Evaluator: closes the control loop and scores models.
    Evaluator,
    /// Read-only observer.
    Viewer,
    /// Robot or program that requests plans.
    Client,
    /// Administrator: changes served models and training runs.
    Operator,
    /// Zenoh router.
    Router,
}

use Role::{Client, Evaluator, Operator, Planner, Trainer, Viewer, Worker};

impl Role {
    /// Every role.
    pub const ALL: [Self; 8] = [Planner, Trainer, Worker, Evaluator, Viewer, Client, Operator, Self::Router];

    /// Name of the role in identities.
    pub fn name(self) -> &'static str {
        match self {
            Planner => "planner",
            Trainer => "trainer",
            Worker => "worker",
            Evaluator => "evaluator",
            Viewer => "viewer",
            Client => "client",
            Operator => "operator",
            Self::Router => "router",
        }
    }

    /// The role of an identity, `ROLE` or `ROLE.NAME`: the common name of a certificate.
    pub fn of(identity: &str) -> Option<Self> {
        let role = identity.split_once('.').map_or(identity, |(role, _)| role);
        role.parse().ok()
    }
}

impl FromStr for Role {
    type Err = Error;

    fn from_str(name: &str) -> Result<Self, Error> {
        Self::ALL.into_iter().find(|role| role.name() == name).ok_or_else(|| {
            let names = Self::ALL.map(Self::name).join(", ");
            Error::invalid("role", format!("one of {names}"), name)
        })
    }
}

impl fmt::Display for Role {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Communication pattern of an endpoint.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Queryable and queries.
    Query,
    /// Publisher and subscribers.
    Publication,
    /// Liveliness token and its watchers.
    Liveliness,
}

/// Endpoint of the network: a family of keys with the roles that may use it.
#[derive(Debug, Clone, Copy)]
pub struct Endpoint {
    /// Communication pattern.
    pub kind: Kind,
    key: fn() -> Result<OwnedKeyExpr, Error>,
    /// Roles that answer, publish or hold the token.
    pub offered_by: &'static [Role],
    /// Roles that query, subscribe or watch.
    pub used_by: &'static [Role],
    /// Paths of the equivalent gRPC methods.
    pub grpc: &'static [&'static str],
    /// Largest payload, in bytes.
    pub max_bytes: usize,
}

impl Endpoint {
    /// Key expression that matches every key of the endpoint.
    ///
    /// # Errors
    /// Never: every chunk may be `*`.
    pub fn key(&self) -> Result<OwnedKeyExpr, Error> {
        (self.key)()
    }
}

/// Roles that may request plans.
const PLANS: &[Role] = &[Evaluator, Client, Operator];

/// All endpoints; access to any other key is denied.
pub const ENDPOINTS: &[Endpoint] = &[
    query(
        || key::planner_plan("*"),
        &[Planner],
        PLANS,
        &["/cpn.v1.PlannerService/Plan", "/inference.GRPCInferenceService/ModelInfer"],
    ),
    query(|| key::planner_register_goal("*"), &[Planner], PLANS, &["/cpn.v1.PlannerService/RegisterGoal"]),
    Endpoint {
        max_bytes: ListModelsResponse::MAX_BYTES,
        ..query(
            || key::planner_list_models("*"),
            &[Planner],
            &[Evaluator, Client, Operator, Viewer],
            &[
                "/cpn.v1.PlannerService/ListModels",
                "/inference.GRPCInferenceService/ServerLive",
                "/inference.GRPCInferenceService/ServerReady",
                "/inference.GRPCInferenceService/ServerMetadata",
                "/inference.GRPCInferenceService/ModelReady",
                "/inference.GRPCInferenceService/ModelMetadata",
                "/inference.GRPCInferenceService/ModelConfig",
            ],
        )
    },
    Endpoint {
        max_bytes: LoadModelRequest::MAX_BYTES,
        ..query(|| key::planner_load_model("*"), &[Planner], &[Operator], &["/cpn.v1.PlannerService/LoadModel"])
    },
    query(|| key::planner_unload_model("*"), &[Planner], &[Operator], &["/cpn.v1.PlannerService/UnloadModel"]),
    zenoh(Kind::Query, || key::sim_reset("*"), &[Worker], &[Evaluator]),
    zenoh(Kind::Query, || key::sim_step("*"), &[Worker], &[Evaluator]),
    zenoh(Kind::Publication, || key::sim_frame("*"), &[Worker], &[Viewer]),
    zenoh(Kind::Publication, || key::sim_action("*"), &[Worker], &[Viewer]),
    zenoh(Kind::Publication, || key::sim_plan("*"), &[Evaluator], &[Viewer]),
    // A trainer may send its recordings to another one, as a worker does.
    zenoh(Kind::Publication, || key::demonstration_step("*", "*"), &[Worker, Trainer], &[Trainer]),
    zenoh(Kind::Query, || key::demonstration_step("*", "*"), &[Trainer], &[Trainer, Viewer]),
    zenoh(Kind::Query, || key::demonstration_commit("*"), &[Trainer], &[Worker, Trainer]),
    zenoh(Kind::Publication, || key::demonstration_recorded("*"), &[Trainer], &[Trainer, Viewer]),
    zenoh(Kind::Query, || key::demonstration_recorded("*"), &[Trainer], &[Worker, Trainer, Viewer]),
    zenoh(Kind::Publication, || key::checkpoint_announcement("*"), &[Trainer], &[Planner, Viewer]),
    zenoh(Kind::Query, || key::checkpoint_chunk("*"), &[Trainer], &[Planner, Operator]),
    Endpoint {
        max_bytes: ListVersionsResponse::MAX_BYTES,
        ..zenoh(Kind::Query, || key::checkpoint_list_versions("*"), &[Trainer], &[Operator, Viewer])
    },
    zenoh(Kind::Query, || key::checkpoint_promote("*"), &[Trainer], &[Operator]),
    zenoh(Kind::Query, || key::checkpoint_roll_back("*"), &[Trainer], &[Operator]),
    query(|| key::trainer_start_run("*"), &[Trainer], &[Operator], &["/cpn.v1.TrainerService/StartRun"]),
    query(|| key::trainer_stop_run("*"), &[Trainer], &[Operator], &["/cpn.v1.TrainerService/StopRun"]),
    Endpoint {
        max_bytes: ListRunsResponse::MAX_BYTES,
        ..query(|| key::trainer_list_runs("*"), &[Trainer], &[Operator, Viewer], &["/cpn.v1.TrainerService/ListRuns"])
    },
    Endpoint {
        grpc: &["/cpn.v1.TrainerService/WatchRun"],
        ..zenoh(Kind::Publication, || key::training_progress("*"), &[Trainer], &[Operator, Viewer])
    },
    zenoh(
        Kind::Liveliness,
        || key::planner_alive("*"),
        &[Planner],
        &[Planner, Trainer, Evaluator, Viewer, Client, Operator],
    ),
    zenoh(Kind::Liveliness, || key::sim_alive("*"), &[Worker], &[Worker, Evaluator, Viewer, Operator]),
    zenoh(Kind::Liveliness, || key::trainer_alive("*"), &[Trainer], &[Trainer, Worker, Viewer, Operator]),
];

/// Roles that may read metrics.
const METRICS: &[Role] = &[Viewer, Operator];

const fn zenoh(
    kind: Kind,
    key: fn() -> Result<OwnedKeyExpr, Error>,
    offered_by: &'static [Role],
    used_by: &'static [Role],
) -> Endpoint {
    Endpoint { kind, key, offered_by, used_by, grpc: &[], max_bytes: PlanRequest::MAX_BYTES }
}

const fn query(
    key: fn() -> Result<OwnedKeyExpr, Error>,
    offered_by: &'static [Role],
    used_by: &'static [Role],
    grpc: &'static [&'static str],
) -> Endpoint {
    Endpoint { grpc, ..zenoh(Kind::Query, key, offered_by, used_by) }
}

/// Whether an identity may call the gRPC method at `path`.
pub fn may_call(identity: &str, path: &str) -> bool {
    let endpoint = ENDPOINTS.iter().find(|endpoint| endpoint.grpc.contains(&path));
    endpoint.zip(Role::of(identity)).is_some_and(|(endpoint, role)| endpoint.used_by.contains(&role))
}

/// Whether an identity may request plans.
pub fn may_plan(identity: &str) -> bool {
    Role::of(identity).is_some_and(|role| PLANS.contains(&role))
}

/// Whether an identity may read metrics.
pub fn may_scrape(identity: &str) -> bool {
    Role::of(identity).is_some_and(|role| METRICS.contains(&role))
}
