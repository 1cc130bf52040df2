//! Configuration in layers: the command line over the environment over a file over the defaults.

use figment::Figment;
use figment::providers::{Env, Format, Serialized, Toml};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::Path;

/// Reads a configuration.
///
/// `arguments` holds what was typed, with `None` (not serialised) where nothing was; `prefix` starts the names of the
/// environment variables, `CPN_PLANNER_` for example; nested fields are separated by two underscores.
///
/// # Errors
/// Names the field, the file or variable it came from, what was expected and what came.
pub fn load<C, A>(prefix: &str, file: Option<&Path>, arguments: &A) -> anyhow::Result<C>
where
    C: Default + Serialize + DeserializeOwned,
    A: Serialize,
{
    let mut figment = Figment::from(Serialized::defaults(C::default()));
    if let Some(file) = file {
        figment = figment.merge(Toml::file_exact(file));
    }
    Ok(figment.merge(Env::prefixed(prefix).split("__")).merge(Serialized::defaults(arguments)).extract()?)
}
