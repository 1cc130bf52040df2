//! Sending what may block, as to a client that does not read.

use std::collections::VecDeque;
use std::fmt;
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};
use std::time::Duration;
use tokio::runtime::Handle;

/// How long one thing may take to send before others are sent beside it.
pub(crate) const PATIENCE: Duration = Duration::from_millis(2);

type Send = Box<dyn FnOnce() + std::marker::Send>;

/// Sends one thing after the other, on a thread that may block; if one takes long, another thread goes on with the rest. Whoever
/// puts things in bounds their number.
#[derive(Clone)]
pub(crate) struct Outbox {
    state: Arc<Mutex<State>>,
    runtime: Handle,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Send>,
    /// Threads that send.
    threads: usize,
    /// Things that were sent.
    sent: u64,
    is_watched: bool,
}

impl Outbox {
    /// One whose threads are those of this runtime.
    pub(crate) fn new(runtime: Handle) -> Self {
        Self { state: Arc::default(), runtime }
    }

    /// Sends something as soon as may be, and does not wait for it.
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

    /// Starts another thread whenever nothing was sent for a while, until nothing waits.
    async fn watch(self) {
        let mut before = self.state().sent;
        loop {
            tokio::time::sleep(PATIENCE).await;
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
