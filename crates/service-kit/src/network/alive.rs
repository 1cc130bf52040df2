//! Names of services, each held by one process, by liveliness tokens.

use crate::session::{IntoAnyhow, SessionConfig, is_connected};
use anyhow::ensure;
use std::time::{Duration, Instant};
use tracing::warn;
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;
use zenoh::liveliness::LivelinessToken;

/// Interval of checks of a token.
const CHECK_INTERVAL: Duration = Duration::from_millis(500);
/// Wait for the first connection before a name can count as free.
const FIRST_CONNECTION: Duration = Duration::from_secs(1);
/// Consecutive checks without a token after which a name counts as free.
const FREE_CHECKS: u32 = 2;
/// Longest time for which a dead process's liveliness token lingers: zenoh's lease, with a margin.
const LEASE: Duration = Duration::from_secs(15);

/// Name that no other process holds.
#[derive(Debug)]
pub struct Name {
    session: Session,
    token: OwnedKeyExpr,
}

impl Name {
    /// Declares the liveliness token, once all that the service offers is declared. The name is free again when it is dropped.
    ///
    /// # Errors
    /// If zenoh refuses the declaration.
    pub async fn alive(self) -> anyhow::Result<LivelinessToken> {
        self.session.liveliness().declare_token(self.token).await.into_anyhow()
    }
}

/// Waits until the name of a liveliness token is free; the token of a killed process lingers for a while. Two processes that start
/// at the same moment can both succeed.
///
/// # Errors
/// If the token is held for longer than zenoh's lease: each of two services of one name would get a part of the requests.
pub async fn claim(session: &Session, config: &SessionConfig, token: OwnedKeyExpr) -> anyhow::Result<Name> {
    let (start, expects_connection) = (Instant::now(), config.expects_connection());
    let (mut free_checks, mut waiting) = (0, false);
    loop {
        // Tokens are invisible before a connection and, for a moment, through a router that was just restarted.
        let connected = !expects_connection || is_connected(session).await;
        let held = is_held(session, &token).await?;
        free_checks = if held { 0 } else { free_checks + 1 };
        let unseen = !connected && start.elapsed() < FIRST_CONNECTION;
        if !expects_connection && !held || free_checks >= FREE_CHECKS && !unseen {
            return Ok(Name { session: session.clone(), token });
        }

        if held && !waiting {
            warn!(%token, "a service of this name is running or has just died; waiting for it to go");
            waiting = true;
        }
        ensure!(
            start.elapsed() < LEASE || !held,
            "name: expected one that no running service has, got that of {token}"
        );
        tokio::time::sleep(CHECK_INTERVAL).await;
    }
}

async fn is_held(session: &Session, token: &OwnedKeyExpr) -> anyhow::Result<bool> {
    let holders = session.liveliness().get(token).timeout(Duration::from_secs(2)).await.into_anyhow()?;
    while let Ok(holder) = holders.recv_async().await {
        if holder.result().is_ok() {
            return Ok(true);
        }
    }
    Ok(false)
}
