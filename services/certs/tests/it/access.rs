//! Every role at every endpoint, through a router with the generated configuration.

use crate::common::Network;
use futures::future::join_all;
use std::collections::{BTreeMap, BTreeSet};
use std::sync::{Arc, Mutex};
use std::time::Duration;
use wire::access::{ENDPOINTS, Endpoint, Kind, Role};
use zenoh::query::QueryTarget;
use zenoh::{Session, Wait};

/// Wait for messages that must not arrive.
const SETTLED: Duration = Duration::from_millis(300);
/// Timeout of messages that must arrive.
const PATIENCE: Duration = Duration::from_secs(60);
/// Timeout of a query.
const TIMEOUT: Duration = Duration::from_secs(2);

type Pairs = BTreeSet<(Role, Role)>;

/// Permitted pairs of roles: the first offers, the second uses. A router may do both.
fn expected(endpoint: &Endpoint) -> Pairs {
    let may = |roles: &[Role], role| role == Role::Router || roles.contains(&role);
    let pairs = Role::ALL.into_iter().flat_map(|offering| Role::ALL.map(|using| (offering, using)));
    pairs.filter(|(offering, using)| may(endpoint.offered_by, *offering) && may(endpoint.used_by, *using)).collect()
}

/// Key at which a role offers.
fn key_of(endpoint: &Endpoint, role: Role) -> String {
    endpoint.key().unwrap().replace('*', role.name())
}

/// Pairs of roles where the second gets an answer of the first.
async fn answered(endpoint: &Endpoint, sessions: &BTreeMap<Role, Session>, expected: &Pairs) -> Pairs {
    let mut queryables = Vec::new();
    for (role, session) in sessions {
        let key = key_of(endpoint, *role);
        let queryable = session.declare_queryable(key.clone()).complete(true);
        queryables.push(queryable.callback(move |query| query.reply(&key, "yes").wait().unwrap()).await.unwrap());
    }
    until(expected, async || {
        let asked = sessions.iter().flat_map(|(using, session)| {
            Role::ALL.map(|offering| async move {
                let key = key_of(endpoint, offering);
                let replies = session.get(key).target(QueryTarget::All).timeout(TIMEOUT).await.unwrap();
                let mut answered = false;
                while let Ok(reply) = replies.recv_async().await {
                    answered |= reply.result().is_ok();
                }
                answered.then_some((offering, *using))
            })
        });
        join_all(asked).await.into_iter().flatten().collect()
    })
    .await
}

/// Pairs of roles where the second receives a publication of the first.
async fn heard(endpoint: &Endpoint, sessions: &BTreeMap<Role, Session>, expected: &Pairs) -> Pairs {
    let heard = Arc::new(Mutex::new(BTreeSet::new()));
    let mut subscribers = Vec::new();
    for (using, session) in sessions {
        let (using, heard) = (*using, Arc::clone(&heard));
        let subscriber = session.declare_subscriber(endpoint.key().unwrap()).callback(move |sample| {
            let offering = sample.payload().try_to_string().unwrap().parse().unwrap();
            heard.lock().unwrap().insert((offering, using));
        });
        subscribers.push(subscriber.await.unwrap());
    }
    until(expected, async || {
        for (offering, session) in sessions {
            session.put(key_of(endpoint, *offering), offering.name()).await.unwrap();
        }
        tokio::time::sleep(SETTLED).await;
        heard.lock().unwrap().clone()
    })
    .await
}

/// Pairs of roles where the second sees the liveliness token of the first.
async fn seen(endpoint: &Endpoint, sessions: &BTreeMap<Role, Session>, expected: &Pairs) -> Pairs {
    let mut tokens = Vec::new();
    for (role, session) in sessions {
        tokens.push(session.liveliness().declare_token(key_of(endpoint, *role)).await.unwrap());
    }
    until(expected, async || {
        let mut seen = Pairs::new();
        for (using, session) in sessions {
            let found = session.liveliness().get(endpoint.key().unwrap()).timeout(TIMEOUT).await.unwrap();
            while let Ok(reply) = found.recv_async().await {
                let Ok(sample) = reply.into_result() else { continue };
                let offering = sample.key_expr().rsplit_once('/').unwrap().1.parse().unwrap();
                seen.insert((offering, *using));
            }
        }
        seen
    })
    .await
}

/// Polls until all expected pairs are there, then waits and polls once more for unexpected ones: declarations take time.
async fn until(expected: &Pairs, look: impl AsyncFn() -> Pairs) -> Pairs {
    let all = async {
        while !look().await.is_superset(expected) {
            tokio::time::sleep(Duration::from_millis(50)).await;
        }
    };
    let _ = tokio::time::timeout(PATIENCE, all).await;
    tokio::time::sleep(SETTLED).await;
    look().await
}

#[tokio::test(flavor = "multi_thread")]
async fn each_role_has_exactly_its_permissions() {
    let network = Network::start().await;
    let mut sessions = BTreeMap::new();
    for role in Role::ALL {
        sessions.insert(role, network.session(role.name()).await);
    }
    for endpoint in ENDPOINTS {
        let mut expected = expected(endpoint);
        // A session reaches itself without the router.
        expected.retain(|(offering, using)| offering != using);
        let found = match endpoint.kind {
            Kind::Query => answered(endpoint, &sessions, &expected).await,
            Kind::Publication => heard(endpoint, &sessions, &expected).await,
            Kind::Liveliness => seen(endpoint, &sessions, &expected).await,
        };
        let found: Pairs = found.into_iter().filter(|(offering, using)| offering != using).collect();
        let denied: Vec<_> = expected.difference(&found).collect();
        let allowed: Vec<_> = found.difference(&expected).collect();
        let key = endpoint.key().unwrap();
        assert!(denied.is_empty() && allowed.is_empty(), "{key}: denied {denied:?}, allowed {allowed:?}");
    }
}
