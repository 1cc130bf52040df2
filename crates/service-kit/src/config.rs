//! Configuration in layers: the command line over the environment over a file over the defaults.
//!
//! An empty environment variable counts as unset, as orchestrators fill in what nobody has set. The field decides what a text
//! means, wherever it stands.

use anyhow::bail;
use clap::builder::Resettable;
use clap::{Command, Parser};
use figment::providers::{Format, Serialized, Toml};
use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::path::Path;
use tracing::warn;

/// Similarity of two names, from 0 to 1, from which on one is taken for a misspelling of the other.
const NEAR_MISS: f64 = 0.9;

/// Parses the command line; ends the process with a message if it is wrong.
pub fn parse<A: Parser>() -> A {
    let matches = without_empty_variables(A::command()).get_matches();
    A::from_arg_matches(&matches).unwrap_or_else(|error| error.exit())
}

/// Lets no option be read from an environment variable that is empty.
fn without_empty_variables(command: Command) -> Command {
    let command = command.mut_args(|arg| {
        let empty = arg.get_env().is_some_and(|name| std::env::var_os(name).is_some_and(|value| value.is_empty()));
        if empty { arg.env(Resettable::Reset) } else { arg }
    });
    command.mut_subcommands(without_empty_variables)
}

/// Reads a configuration.
///
/// `arguments` holds the options that were given, with `None` (not serialised) for the others; `prefix` starts the names of
/// the environment variables, `CPN_PLANNER_` for example; nested fields are separated by two underscores.
///
/// # Errors
/// Names the field, the file or variable it came from, what was expected and what came.
pub fn load<C, A>(prefix: &str, file: Option<&Path>, arguments: &A) -> anyhow::Result<C>
where
    C: Default + Serialize + DeserializeOwned,
    A: Serialize,
{
    load_from(prefix, file, arguments, environment())
}

fn load_from<C, A>(
    prefix: &str,
    file: Option<&Path>,
    arguments: &A,
    environment: impl IntoIterator<Item = (String, String)>,
) -> anyhow::Result<C>
where
    C: Default + Serialize + DeserializeOwned,
    A: Serialize,
{
    let defaults = serde_json::to_value(C::default())?;
    let fields: Vec<_> = defaults.as_object().into_iter().flat_map(serde_json::Map::keys).map(String::as_str).collect();
    let mut figment = Figment::from(Serialized::defaults(C::default()));
    if let Some(file) = file {
        figment = figment.merge(Toml::file_exact(file));
    }
    for variable in variables(prefix, &fields, |_, text| value(text), environment)? {
        figment = figment.merge(variable);
    }
    Ok(figment.merge(Serialized::defaults(arguments)).extract_lossy()?)
}

/// The environment, as far as it is text.
pub fn environment() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os().filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
}

/// The variables of the environment that set one of `fields`, or a part of it. Others of the prefix are passed over, with a
/// line in the log: Kubernetes injects such names. `read` makes a value of a key and its text.
///
/// # Errors
/// If a name is nearly that of a field.
pub fn variables(
    prefix: &str,
    fields: &[&str],
    read: impl Fn(&str, &str) -> Value,
    environment: impl IntoIterator<Item = (String, String)>,
) -> anyhow::Result<Vec<Variable>> {
    let mut variables = Vec::new();
    for (name, text) in environment {
        let Some(key) = name.strip_prefix(prefix) else { continue };
        if text.is_empty() {
            continue;
        }
        let key = key.to_lowercase().replace("__", ".");
        let field = key.split('.').next().unwrap_or_default();
        if fields.contains(&field) {
            variables.push(Variable { value: read(&key, &text), name, key });
            continue;
        }
        if let Some(near) = fields.iter().find(|known| strsim::jaro_winkler(known, field) >= NEAR_MISS) {
            let near = near.to_uppercase();
            bail!("{name}: expected the name of a setting, as {prefix}{near}, got one that is nearly that");
        }
        warn!(variable = name, "no setting has this name; it is passed over");
    }
    Ok(variables)
}

/// A setting from the environment.
#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    name: String,
    /// Field, or fields within each other, separated by dots.
    key: String,
    value: Value,
}

impl Provider for Variable {
    fn metadata(&self) -> Metadata {
        Metadata::named(format!("environment variable {}", self.name))
    }

    fn data(&self) -> figment::Result<Map<Profile, Dict>> {
        let nested = figment::util::nest(&self.key, self.value.clone());
        Ok(nested.into_dict().map(|dict| Profile::Default.collect(dict)).unwrap_or_default())
    }
}

/// A value that is written as text: a list or table where it looks like one, and text otherwise, of which the field
/// makes a number or truth where it is one.
fn value(text: &str) -> Value {
    if text.starts_with(['[', '{']) { text.parse().unwrap_or_else(|never| match never {}) } else { Value::from(text) }
}

#[cfg(test)]
#[expect(clippy::unwrap_used, reason = "tests")]
mod tests {
    use super::*;
    use serde::Deserialize;
    use std::num::NonZeroU16;
    use std::path::PathBuf;

    #[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
    #[serde(deny_unknown_fields, default)]
    struct Config {
        name: String,
        folder: PathBuf,
        queue_capacity: NonZeroU16,
        listen: Option<std::net::SocketAddr>,
        tasks: Vec<String>,
        quick: bool,
    }

    impl Default for Config {
        fn default() -> Self {
            let (name, folder) = ("planner".into(), "models".into());
            Self { name, folder, queue_capacity: NonZeroU16::MIN, listen: None, tasks: Vec::new(), quick: false }
        }
    }

    fn load(file: &str, variables: &[(&str, &str)]) -> anyhow::Result<Config> {
        let mut toml = tempfile::NamedTempFile::new()?;
        std::io::Write::write_all(&mut toml, file.as_bytes())?;
        let variables = variables.iter().map(|(name, value)| ((*name).to_owned(), (*value).to_owned()));
        load_from("CPN_TEST_", Some(toml.path()), &Dict::new(), variables)
    }

    #[test]
    fn the_field_decides_what_a_text_means() {
        let config = load(
            "",
            &[
                ("CPN_TEST_NAME", "7"),
                ("CPN_TEST_FOLDER", "2024"),
                ("CPN_TEST_QUEUE_CAPACITY", "64"),
                ("CPN_TEST_LISTEN", "127.0.0.1:1"),
                ("CPN_TEST_TASKS", "[reach, push]"),
                ("CPN_TEST_QUICK", "true"),
            ],
        );
        let config = config.unwrap();
        assert_eq!((config.name.as_str(), config.folder, config.queue_capacity.get()), ("7", "2024".into(), 64));
        assert_eq!((config.listen.unwrap().port(), config.tasks.len(), config.quick), (1, 2, true));
        assert_eq!(load("", &[("CPN_TEST_NAME", "true")]).unwrap().name, "true");
        // The same text in a file.
        assert_eq!(load("queue_capacity = '64'", &[]).unwrap().queue_capacity.get(), 64);
    }

    #[test]
    fn what_is_empty_or_of_others_is_passed_over_and_what_is_misspelt_is_not() {
        let injected = [
            ("CPN_TEST_NAME", ""),
            ("CPN_TEST_LISTEN", ""),
            ("CPN_TEST_PORT", "tcp://10.0.0.1:1"),
            ("CPN_TEST_SERVICE_HOST", "10.0.0.1"),
            ("CPN_TEST_PORT_50051_TCP_ADDR", "10.0.0.1"),
            ("CPN_OTHER_NAME", "7"),
        ];
        assert_eq!(load("", &injected).unwrap(), Config::default());
        let error = load("", &[("CPN_TEST_QUEUE_CAPACTY", "7")]).unwrap_err().to_string();
        assert!(error.starts_with("CPN_TEST_QUEUE_CAPACTY: expected the name of a setting"), "{error}");
        let error = load("", &[("CPN_TEST_QUEUE_CAPACITY", "many")]).unwrap_err().to_string();
        assert!(error.contains("CPN_TEST_QUEUE_CAPACITY") && error.contains("many"), "{error}");
        let error = load("", &[("CPN_TEST_TASKS", "[reach")]).unwrap_err().to_string();
        assert!(error.contains("CPN_TEST_TASKS"), "{error}");
    }
}
