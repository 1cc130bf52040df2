//! Layered configuration: the command line over the environment over a file over the defaults.
//!
//! A service has one settings struct, whose fields are also the options of its command line and have their defaults. An empty
//! environment variable counts as unset, since orchestrators set unset ones to the empty string. Text is parsed by the
//! field's type, in every layer.

use anyhow::bail;
use clap::builder::Resettable;
use clap::parser::ValueSource;
use clap::{ArgMatches, Command, Parser};
use figment::providers::{Format, Serialized, Toml};
use figment::value::{Dict, Map, Value};
use figment::{Figment, Metadata, Profile, Provider};
use serde::Serialize;
use serde::de::DeserializeOwned;
use std::ffi::{OsStr, OsString};
use std::path::Path;
use tracing::warn;

/// Jaro-Winkler similarity, from 0 to 1, at and above which a name is taken for a misspelling of another.
const NEAR_MISS: f64 = 0.9;

/// Parses the command line; exits with a message if it is invalid.
pub fn parse<A: Parser>() -> A {
    parse_with_sources().0
}

/// Parses the command line, with the sources of its options; exits with a message if it is invalid.
pub fn parse_with_sources<A: Parser>() -> (A, Sources) {
    parse_from(std::env::args_os()).unwrap_or_else(|error| error.exit())
}

/// Parses a command line, whose first argument is the program's name.
///
/// # Errors
/// If the command line is invalid, with the message for the user.
pub fn parse_from<A, T>(line: impl IntoIterator<Item = T>) -> Result<(A, Sources), clap::Error>
where
    A: Parser,
    T: Into<OsString> + Clone,
{
    let is_empty = |name: &OsStr| std::env::var_os(name).is_some_and(|value| value.is_empty());
    let mut matches = without_variables(A::command(), &is_empty).try_get_matches_from(line)?;
    let arguments = A::from_arg_matches(&matches)?;
    while let Some((_, of_subcommand)) = matches.remove_subcommand() {
        matches = of_subcommand;
    }
    Ok((arguments, Sources(matches)))
}

/// Sources of the options of a command, or of its subcommand if there is one: the command line, an option's environment
/// variable, its default.
#[derive(Debug)]
pub struct Sources(ArgMatches);

impl Sources {
    /// Explicit settings: those of `settings` from the command line or an option's environment variable.
    ///
    /// # Errors
    /// If the settings cannot be serialised.
    fn given(&self, settings: &impl Serialize) -> serde_json::Result<serde_json::Value> {
        let mut settings = serde_json::to_value(settings)?;
        self.retain_given(&mut settings);
        Ok(settings)
    }

    fn retain_given(&self, settings: &mut serde_json::Value) {
        let Some(settings) = settings.as_object_mut() else { return };
        settings.retain(|name, value| match self.0.ids().any(|id| id == name.as_str()) {
            true => self.0.value_source(name) != Some(ValueSource::DefaultValue),
            // Options are flat, and the structs flattened into them are tables in a file.
            false => {
                self.retain_given(value);
                value.as_object().is_some_and(|nested| !nested.is_empty())
            }
        });
    }
}

/// Default settings: the defaults of their options.
///
/// # Panics
/// If an option has no default.
pub fn defaults<C: clap::Args>() -> C {
    let command = without_variables(C::augment_args(Command::new("defaults")), &|_| true);
    let defaults = command.try_get_matches_from(["defaults"]).and_then(|matches| C::from_arg_matches(&matches));
    defaults.expect("every option has a default")
}

/// Parses the value of an option by its name in configuration files.
///
/// # Errors
/// If there is no such value, with the expected names.
pub fn from_name<T: DeserializeOwned>(name: &str) -> Result<T, serde_json::Error> {
    serde_json::from_value(name.into())
}

/// The command without the environment variables of its options that are `ignored`.
fn without_variables(command: Command, ignored: &impl Fn(&OsStr) -> bool) -> Command {
    let command =
        command.mut_args(|arg| if arg.get_env().is_some_and(ignored) { arg.env(Resettable::Reset) } else { arg });
    command.mut_subcommands(|subcommand| without_variables(subcommand, ignored))
}

/// Loads a configuration of all layers; `settings` and `sources` are those of the command line. `prefix` starts the names of
/// the environment variables, for example `CPN_PLANNER_`; two underscores separate nested fields.
///
/// # Errors
/// If the file cannot be read, a field is unknown or invalid, or a variable is misspelt. The error names the field, its file or
/// variable, what was expected and what came.
pub fn load<C>(prefix: &str, file: Option<&Path>, settings: &C, sources: &Sources) -> anyhow::Result<C>
where
    C: Default + Serialize + DeserializeOwned,
{
    load_from(prefix, file, &sources.given(settings)?, environment())
}

fn load_from<C>(
    prefix: &str,
    file: Option<&Path>,
    given: &impl Serialize,
    environment: impl IntoIterator<Item = (String, String)>,
) -> anyhow::Result<C>
where
    C: Default + Serialize + DeserializeOwned,
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
    Ok(figment.merge(Serialized::defaults(given)).extract_lossy()?)
}

/// Environment variables whose names and values are Unicode.
pub fn environment() -> impl Iterator<Item = (String, String)> {
    std::env::vars_os().filter_map(|(name, value)| Some((name.into_string().ok()?, value.into_string().ok()?)))
}

/// Environment variables that set one of `fields` or a part of it, each parsed by `read` from its key and text. Others of the
/// prefix are ignored with a warning, since Kubernetes injects such names.
///
/// # Errors
/// If a name looks like a misspelling of a field.
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

/// Setting from the environment.
#[derive(Debug, Clone, PartialEq)]
pub struct Variable {
    name: String,
    /// Path of the field, separated by dots.
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

/// Parses the text of a variable: a list or table if it starts like one, else a string, which the field's type converts to a
/// number or boolean.
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
    fn text_is_parsed_by_the_type_of_the_field() {
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
    fn empty_and_unknown_variables_are_ignored_and_misspelt_ones_refused() {
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
