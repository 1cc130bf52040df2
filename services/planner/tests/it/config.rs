//! Layers of the configuration.

use planner::Config;
use planner::config::Args;
use service_kit::config;
use signing::Trust;
use std::io::Write;
use std::path::PathBuf;
use tempfile::NamedTempFile;

fn load(file: &str, arguments: &[&str]) -> anyhow::Result<Config> {
    let mut toml = NamedTempFile::new()?;
    toml.write_all(file.as_bytes())?;
    let (Args { config, .. }, sources) = config::parse_from([&["cpn-planner"], arguments].concat())?;
    config::load("CPN_PLANNER_TEST_", Some(toml.path()), &config, &sources)
}

#[test]
fn unset_settings_have_their_defaults() {
    assert_eq!(load("", &[]).unwrap(), Config::default());
}

#[test]
fn a_default_does_not_win_over_the_file() {
    let file = "queue_capacity = 7\nprecision = 'bfloat16'\ngrpc_listen = '127.0.0.1:1'";
    let config = load(file, &["--queue-capacity", "64"]).unwrap();
    assert_eq!((config.queue_capacity.get(), config.grpc_listen.port()), (64, 1));
    assert_eq!(config.precision, cpn::Precision::Bfloat16);
}

#[test]
fn the_command_line_wins_over_the_file() {
    let file = "name = 'from-file'\nqueue_capacity = 7\n[session]\nlisten = ['tcp/127.0.0.1:1']\nnamespace = 'f'";
    let config = load(file, &["--name", "typed", "--namespace", "t", "--connect", "tcp/a:1,tcp/b:2"]).unwrap();
    assert_eq!((config.name.as_str(), config.queue_capacity.get()), ("typed", 7));
    assert_eq!(config.session.listen, ["tcp/127.0.0.1:1"]);
    assert_eq!(config.session.connect, ["tcp/a:1", "tcp/b:2"]);
    assert_eq!(config.session.namespace.as_deref(), Some("t"));
}

#[test]
fn openpi_listens_at_the_configured_address() {
    let [file, typed] = ["127.0.0.1:8000", "127.0.0.1:8001"];
    let toml = format!("openpi_listen = '{file}'");
    for (arguments, expected) in [(&[][..], file), (&["--openpi-listen", typed], typed)] {
        assert_eq!(load(&toml, arguments).unwrap().openpi_listen, Some(expected.parse().unwrap()));
    }
}

#[test]
fn trusted_keys_are_a_list_or_a_string() {
    let none = load("", &[]).unwrap();
    assert_eq!((none.trust, none.trusted_keys.len()), (None, 0));
    let expected = ["a.pem", "b/c.pem"].map(PathBuf::from);
    for (file, arguments) in [
        ("trusted_keys = ['a.pem', 'b/c.pem']", &[][..]),
        // As in the environment.
        ("trusted_keys = 'a.pem,b/c.pem'", &[]),
        ("trusted_keys = 'x.pem'", &["--trusted-keys", "a.pem,b/c.pem"]),
        ("", &["--trusted-keys", "a.pem", "--trusted-keys", "b/c.pem"]),
    ] {
        assert_eq!(load(file, arguments).unwrap().trusted_keys, expected, "{file}");
    }
    for (arguments, expected) in [(&[][..], Trust::Warn), (&["--trust", "enforce"], Trust::Enforce)] {
        assert_eq!(load("trust = 'warn'", arguments).unwrap().trust, Some(expected));
    }
}

#[test]
fn a_wrong_setting_is_named() {
    for (file, field) in [
        ("queue_capacity = 0", "queue_capacity"),
        ("openpi_listen = 8000", "openpi_listen"),
        ("thread = 1", "thread"),
        ("trust = 'some'", "trust"),
        ("trusted_keys = 1", "trusted_keys"),
    ] {
        let error = format!("{:#}", load(file, &[]).unwrap_err());
        assert!(error.contains(field), "{error}");
    }
}
