//! Entry point of a service's process.

use std::ffi::OsStr;
use std::future::Future;

/// Environment variable with the settings of zenoh's threads.
pub(crate) const ZENOH_RUNTIME: &str = "ZENOH_RUNTIME";
/// Zenoh's links on a single thread: its TLS links read and write one stream from two threads at once, which corrupts memory
/// sooner or later (eclipse-zenoh/zenoh#2557).
const ONE_THREAD: &str = "(rx: (worker_threads: 1), tx: (handover: rx))";
/// Options, and suffixes of environment variables, that may enable TLS.
const OPTIONS: [&str; 3] = ["--tls-ca", "--zenoh-config", "--config"];
const VARIABLES: [&str; 2] = ["TLS_CA", "ZENOH_CONFIG"];

/// Runs a program on tokio's multi-threaded runtime. If it may use TLS, zenoh's links are confined to one thread, unless the
/// environment sets `ZENOH_RUNTIME`.
///
/// # Errors
/// If the runtime cannot be started, or the program fails.
pub fn run<T>(program: impl Future<Output = anyhow::Result<T>>) -> anyhow::Result<T> {
    if may_use_tls() && std::env::var_os(ZENOH_RUNTIME).is_none() {
        #[expect(unsafe_code, reason = "no other thread has been started that could read the environment")]
        unsafe {
            std::env::set_var(ZENOH_RUNTIME, ONE_THREAD);
        }
    }
    tokio::runtime::Runtime::new()?.block_on(program)
}

fn may_use_tls() -> bool {
    let option = |argument: &OsStr| OPTIONS.iter().any(|option| argument.to_string_lossy().starts_with(option));
    let variable = |(name, value): (std::ffi::OsString, std::ffi::OsString)| {
        !value.is_empty() && VARIABLES.iter().any(|end| name.to_string_lossy().ends_with(end))
    };
    std::env::args_os().any(|argument| option(&argument)) || std::env::vars_os().any(variable)
}
