//! Running a program.

use std::ffi::OsStr;
use std::future::Future;

/// Environment variable with the settings of zenoh's threads.
pub(crate) const ZENOH_RUNTIME: &str = "ZENOH_RUNTIME";
/// Reading and writing of links on one thread. Zenoh's TLS links read and write the same stream from two threads at once,
/// which corrupts memory sooner or later (eclipse-zenoh/zenoh#2557).
const ONE_THREAD: &str = "(rx: (worker_threads: 1), tx: (handover: rx))";
/// Options, and ends of the names of environment variables, with which TLS may come.
const OPTIONS: [&str; 3] = ["--tls-ca", "--zenoh-config", "--config"];
const VARIABLES: [&str; 2] = ["TLS_CA", "ZENOH_CONFIG"];

/// Runs a program on tokio's threads. Where it may use TLS, zenoh is told to read and write its links on one thread, unless the
/// environment says otherwise.
///
/// # Errors
/// If no threads can be started, or those of the program.
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
