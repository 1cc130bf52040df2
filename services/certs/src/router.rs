//! Configuration of a zenoh router with access control by role.

use crate::identities::Identities;
use anyhow::Context;
use serde_json::{Value, json};
use service_kit::session::IntoAnyhow;
use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;
use wire::access::{ENDPOINTS, Endpoint, Kind, Role};

/// Listening endpoint of a router.
const LISTEN: &str = "tls/0.0.0.0:7447";
/// Maximum number of connections of a router.
const MAX_SESSIONS: usize = 1000;
/// Length of a link's queue, in batches of up to 64 KiB: zenoh's maximum.
const QUEUE_BATCHES: usize = 16;
/// Highest rate of a worker's frames, of its actions and of its plans, per second, for viewers.
const FRAMES_PER_SECOND: f64 = 200.0;
/// Allowance for attachments beside a payload, in bytes.
const ATTACHMENT_BYTES: usize = 1024;
/// All message types of zenoh's access control.
const MESSAGES: [&str; 9] = [
    "put",
    "delete",
    "declare_subscriber",
    "query",
    "reply",
    "declare_queryable",
    "liveliness_token",
    "liveliness_query",
    "declare_liveliness_subscriber",
];

/// Message type that a role may exchange with a router, and its direction as seen from the router.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
struct Permission {
    flow: &'static str,
    message: &'static str,
}

/// Configuration of `zenohd`, whose certificate files are in `folder`.
///
/// # Errors
/// If a namespace cannot stand in a key.
pub fn config(folder: &Path, identities: &Identities) -> anyhow::Result<Value> {
    let file = |name: &str| json!(folder.join(name));
    let namespaces = &identities.namespaces;
    Ok(json!({
        "mode": "router",
        "listen": { "endpoints": [LISTEN] },
        "connect": { "endpoints": [], "timeout_ms": -1, "exit_on_failure": false },
        "scouting": { "multicast": { "enabled": false }, "gossip": { "enabled": true } },
        "adminspace": { "enabled": false },
        "transport": {
            "unicast": { "max_sessions": MAX_SESSIONS },
            "link": {
                "protocols": ["tls"],
                "rx": { "max_message_size": wire_max_bytes() },
                // TLS links run on one thread, where a full queue is drained only after its sender has given up: long queues.
                "tx": { "queue": { "size": { "data": QUEUE_BATCHES, "data_low": QUEUE_BATCHES } } },
                "tls": {
                    "root_ca_certificate": file("ca.pem"),
                    "listen_certificate": file("certificate.pem"),
                    "listen_private_key": file("private-key.pem"),
                    "connect_certificate": file("certificate.pem"),
                    "connect_private_key": file("private-key.pem"),
                    "enable_mtls": true,
                    "close_link_on_expiration": true,
                },
            },
            "shared_memory": { "enabled": false },
        },
        "access_control": access_control(identities)?,
        "low_pass_filter": low_pass_filter(namespaces)?,
        "downsampling": downsampling(namespaces)?,
    }))
}

/// Largest payload of any endpoint, with its attachment, in bytes.
fn wire_max_bytes() -> usize {
    let largest = ENDPOINTS.iter().map(|endpoint| endpoint.max_bytes).max();
    largest.unwrap_or_default() + ATTACHMENT_BYTES
}

/// Key expressions of an endpoint, one per namespace.
fn keys(endpoint: &Endpoint, namespaces: &BTreeSet<String>) -> anyhow::Result<Vec<String>> {
    let key = endpoint.key()?;
    if namespaces.is_empty() {
        return Ok(vec![key.to_string()]);
    }
    let below = |namespace: &String| {
        let key = zenoh::key_expr::KeyExpr::new(format!("{namespace}/{key}"));
        Ok(key.into_anyhow().with_context(|| format!("namespace {namespace}"))?.to_string())
    };
    namespaces.iter().map(below).collect()
}

/// Permissions of the roles that offer an endpoint, and of those that use it.
fn permissions(kind: Kind) -> (&'static [Permission], &'static [Permission]) {
    const fn to_router(message: &'static str) -> Permission {
        Permission { flow: "ingress", message }
    }
    const fn from_router(message: &'static str) -> Permission {
        Permission { flow: "egress", message }
    }

    match kind {
        Kind::Query => (
            &const { [to_router("declare_queryable"), to_router("reply"), from_router("query")] },
            &const { [to_router("query"), from_router("reply"), from_router("declare_queryable")] },
        ),
        Kind::Publication => (
            &const { [to_router("put"), from_router("declare_subscriber")] },
            &const { [to_router("declare_subscriber"), from_router("put")] },
        ),
        Kind::Liveliness => (
            &const { [to_router("liveliness_token")] },
            &const {
                [
                    to_router("liveliness_query"),
                    to_router("declare_liveliness_subscriber"),
                    from_router("liveliness_token"),
                ]
            },
        ),
    }
}

/// Access control: deny by default, and the permissions of each role. Zenoh compares common names exactly, so that every
/// identity is listed.
fn access_control(identities: &Identities) -> anyhow::Result<Value> {
    let mut allowed: BTreeMap<(Role, Permission), BTreeSet<String>> = BTreeMap::new();
    for endpoint in ENDPOINTS {
        let keys = keys(endpoint, &identities.namespaces)?;
        let (offering, using) = permissions(endpoint.kind);
        for (roles, permissions) in [(endpoint.offered_by, offering), (endpoint.used_by, using)] {
            for (role, permission) in roles.iter().flat_map(|role| permissions.iter().map(move |p| (*role, *p))) {
                allowed.entry((role, permission)).or_default().extend(keys.iter().cloned());
            }
        }
    }

    let (mut rules, mut subjects, mut policies) = (Vec::new(), Vec::new(), Vec::new());
    for role in Role::ALL {
        let of_role = identities
            .identities
            .iter()
            .filter(|(name, identity)| Role::of(name) == Some(role) && identity.revoked.is_none());
        let names: Vec<_> = of_role.map(|(name, _)| name).collect();
        if names.is_empty() {
            continue;
        }

        let mut ids = Vec::new();
        if role == Role::Router {
            // `**` does not match a verbatim chunk, so that every key is listed too.
            let mut keys = BTreeSet::from(["**".to_owned()]);
            for endpoint in ENDPOINTS {
                keys.extend(self::keys(endpoint, &identities.namespaces)?);
            }
            rules.push(json!({
                "id": "router", "permission": "allow", "flows": ["ingress", "egress"], "messages": MESSAGES,
                "key_exprs": keys,
            }));
            ids.push("router".to_owned());
        }
        for ((_, Permission { flow, message }), keys) in
            allowed.range((role, FIRST)..).take_while(|((r, _), _)| *r == role)
        {
            let id = format!("{role} {flow} {message}");
            rules.push(json!({
                "id": id, "permission": "allow", "flows": [flow], "messages": [message], "key_exprs": keys,
            }));
            ids.push(id);
        }

        subjects.push(json!({ "id": role.name(), "cert_common_names": names }));
        policies.push(json!({ "rules": ids, "subjects": [role.name()] }));
    }
    Ok(json!({
        "enabled": true, "default_permission": "deny", "rules": rules, "subjects": subjects, "policies": policies,
    }))
}

/// Least value in the order of permissions.
const FIRST: Permission = Permission { flow: "", message: "" };

/// Low-pass filter, which drops payloads above the limits of their endpoints.
fn low_pass_filter(namespaces: &BTreeSet<String>) -> anyhow::Result<Value> {
    let mut by_size: BTreeMap<usize, BTreeSet<String>> = BTreeMap::new();
    for endpoint in ENDPOINTS.iter().filter(|endpoint| endpoint.kind != Kind::Liveliness) {
        by_size.entry(endpoint.max_bytes).or_default().extend(keys(endpoint, namespaces)?);
    }
    let filters = by_size.into_iter().map(|(max_bytes, keys)| {
        json!({
            "id": format!("at most {max_bytes} bytes"), "flows": ["ingress"], "messages": ["put", "query", "reply"],
            "key_exprs": keys, "size_limit": max_bytes + ATTACHMENT_BYTES,
        })
    });
    Ok(filters.collect())
}

/// Downsampling, which bounds the rate of publications for viewers.
fn downsampling(namespaces: &BTreeSet<String>) -> anyhow::Result<Value> {
    let mut rules = Vec::new();
    for endpoint in ENDPOINTS.iter().filter(|endpoint| endpoint.used_by == [Role::Viewer]) {
        for key in keys(endpoint, namespaces)? {
            rules.push(json!({ "key_expr": key, "freq": FRAMES_PER_SECOND }));
        }
    }
    Ok(json!([{ "id": "viewers", "flows": ["ingress"], "messages": ["put"], "rules": rules }]))
}
