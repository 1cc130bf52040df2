//! Typed requests, retried while a service is unavailable.

use backon::{ExponentialBuilder, Retryable};
use std::time::{Duration, Instant};
use tracing::debug;
use wire::{Code, Error, Message, query};
use zenoh::Session;
use zenoh::key_expr::OwnedKeyExpr;

/// Retry policy of a request.
#[derive(Debug, Clone, Copy)]
pub struct Retry {
    /// Delay after the first failed attempt, and the longest: delays double, and up to as much again is added at random, so that
    /// clients of one service spread.
    pub delays: [Duration; 2],
    /// Time, from the first failed attempt, after which an error is returned.
    pub patience: Duration,
    /// Whether an error is transient; others are returned at once.
    pub when: fn(&Error) -> bool,
}

impl Retry {
    /// Repeats an attempt until it succeeds.
    ///
    /// # Errors
    /// The first error that is not transient, or the last one once the patience is over.
    pub async fn run<T, F>(self, attempt: impl FnMut() -> F) -> Result<T, Error>
    where
        F: Future<Output = Result<T, Error>>,
    {
        let Self { delays: [shortest, longest], patience, when } = self;
        let delays = ExponentialBuilder::default().with_min_delay(shortest).with_max_delay(longest);
        let mut first = None;
        attempt
            .retry(delays.with_jitter().without_max_times())
            .when(|error| when(error) && first.get_or_insert_with(Instant::now).elapsed() < patience)
            .notify(|error, _| debug!("asking again: {error}"))
            .await
    }
}

/// Sends a request and awaits its single answer, with a timeout for each attempt.
///
/// # Errors
/// As [`query::call`], once no retry is left.
pub async fn ask<Q: Message + Clone, R: Message>(
    session: &Session,
    key: &OwnedKeyExpr,
    request: Q,
    timeout: Duration,
    retry: Retry,
) -> Result<R, Error> {
    retry.run(|| query::call(session, key, request.clone(), timeout)).await
}

/// Whether the same request may be answered later. After a missed deadline it may have arrived already: only a request that can be
/// repeated without effect is to be asked again.
pub fn is_outage(error: &Error) -> bool {
    matches!(error.code, Code::Unavailable | Code::DeadlineExceeded | Code::ResourceExhausted)
}
