//! Queue of replies that may block, as to a client that does not read.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::runtime::Handle;

/// Time after which a reply counts as blocked, and others are sent by another thread.
pub(crate) const STALL_TIMEOUT: Duration = Duration::from_millis(2);

/// Deferred reply.
type Send = Box<dyn FnOnce() + std::marker::Send>;

/// Queue that sends replies in order, on a thread that may block; while one blocks, another thread continues with the rest. It
/// is unbounded: callers bound their replies in flight.
#[derive(Clone)]
pub(crate) struct Outbox {
    state: Arc<Mutex<State>>,
    runtime: Handle,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Send>,
    /// Number of sending threads.
    threads: usize,
    /// Number of replies sent.
    sent: u64,
    is_watched: bool,
}

impl Outbox {
    /// Outbox that sends on the blocking threads of a runtime.
    pub(crate) fn new(runtime: Handle) -> Self {
        Self { state: Arc::default(), runtime }
    }

    /// Queues a reply; does not block.
    pub(crate) fn put(&self, send: impl FnOnce() + std::marker::Send + 'static) {
        let mut state = self.state();
        state.waiting.push_back(Box::new(send));
        if state.threads == 0 {
            self.start(&mut state);
        } else if !std::mem::replace(&mut state.is_watched, true) {
            self.runtime.spawn(self.clone().watch());
        }
    }

    fn start(&self, state: &mut State) {
        state.threads += 1;
        let this = self.clone();
        self.runtime.spawn_blocking(move || this.send());
    }

    fn send(self) {
        let mut state = self.state();
        while let Some(send) = state.waiting.pop_front() {
            drop(state);
            send();
            state = self.state();
            state.sent += 1;
        }
        state.threads -= 1;
    }

    /// Watchdog: starts another thread whenever nothing was sent during the stall timeout, until the queue is empty.
    async fn watch(self) {
        let mut before = self.state().sent;
        loop {
            tokio::time::sleep(STALL_TIMEOUT).await;
            let mut state = self.state();
            if state.waiting.is_empty() {
                state.is_watched = false;
                return;
            }
            if std::mem::replace(&mut before, state.sent) == state.sent {
                self.start(&mut state);
            }
        }
    }

    fn state(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

impl fmt::Debug for Outbox {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Outbox")
    }
}
