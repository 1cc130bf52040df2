//! `cpn-certs`: certificates, tokens and a router's configuration, by role.

use certs::Authority;
use clap::{Args, Parser, Subcommand};
use comfy_table::{LineStyle, Table, presets};
use service_kit::output;
use std::collections::BTreeSet;
use std::path::PathBuf;
use time::OffsetDateTime;
use time::format_description::well_known::Rfc3339;

/// Certificates, tokens and a router's configuration for one network.
///
/// An identity is ROLE or ROLE.NAME; the roles are planner, trainer, worker, evaluator, viewer, client, operator and router.
/// Services read their files when they start: restart them, one after the other, after a change.
#[derive(Debug, Parser)]
#[command(name = "cpn-certs", version)]
struct Cli {
    #[command(flatten)]
    folder: Folder,
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Args)]
struct Folder {
    /// Folder of the authority, and of a folder for each identity.
    #[arg(long, env = "CPN_CERTS_DIR", default_value = "certs", global = true)]
    dir: PathBuf,
    /// Lifetime of new certificates, in days.
    #[arg(long, env = "CPN_CERTS_DAYS", default_value_t = 90, global = true, value_parser = clap::value_parser!(u16).range(1..=3650))]
    days: u16,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Make an authority, a certificate for each role and the router's configuration, as far as they are missing; renew certificates
    /// that expire soon.
    Init {
        /// Host names and addresses of the services, separated by commas.
        #[arg(long, value_delimiter = ',')]
        host: Vec<String>,
        /// Namespaces that the router lets through [default: keys without a namespace].
        #[arg(long, value_delimiter = ',')]
        namespace: Vec<String>,
    },
    /// Issue a certificate.
    Issue {
        /// Identity, ROLE or ROLE.NAME.
        identity: String,
        /// Host names and addresses of the service, separated by commas.
        #[arg(long, value_delimiter = ',')]
        host: Vec<String>,
    },
    /// Renew certificates.
    Renew {
        /// Identities [default: those with less than a third of their lifetime left].
        identities: Vec<String>,
    },
    /// Revoke an identity with all its certificates and tokens, for good.
    Revoke {
        /// Identity, ROLE or ROLE.NAME.
        identity: String,
    },
    /// Issue a token, for clients of gRPC, openpi and metrics without a certificate. It is printed once, and kept nowhere.
    Token {
        /// Identity, ROLE or ROLE.NAME.
        identity: String,
    },
    /// List all identities.
    List,
}

fn main() -> anyhow::Result<()> {
    let Cli { folder: Folder { dir, days }, command } = service_kit::config::parse();
    let mut authority = Authority::open(&dir, days)?;
    match command {
        Command::Init { host, namespace } => {
            authority.init(&set(host), set(namespace))?;
            authority.lay_tokens()
        }
        Command::Issue { identity, host } => {
            authority.issue(&identity, &set(host))?;
            authority.lay_tokens()
        }
        Command::Renew { identities } => authority.renew(&identities),
        Command::Revoke { identity } => {
            authority.revoke_tokens(&identity)?;
            authority.revoke(&identity)
        }
        Command::Token { identity } => output::print_line(authority.issue_token(&identity)?),
        Command::List => list(&authority),
    }
}

fn set(values: Vec<String>) -> BTreeSet<String> {
    values.into_iter().filter(|value| !value.is_empty()).collect()
}

fn list(authority: &Authority) -> anyhow::Result<()> {
    let mut table = Table::new();
    table.load_style(presets::UTF8_HORIZONTAL_ONLY.row_separator(LineStyle::none()));
    table.set_header(["identity", "expires", "state", "hosts"]);
    let now = OffsetDateTime::now_utc();
    for (name, identity) in &authority.identities().identities {
        let state = match identity.revoked {
            Some(_) => "revoked",
            None if identity.not_after < now => "expired",
            None if identity.expires_soon(now) => "expires soon",
            None => "valid",
        };
        let hosts: Vec<_> = identity.hosts.iter().map(String::as_str).collect();
        table.add_row([name.as_str(), &identity.not_after.format(&Rfc3339)?, state, &hosts.join(", ")]);
    }
    output::print_line(table)
}
