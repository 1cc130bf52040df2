//! A certificate authority for one network: certificates and tokens by role, and a router's configuration.
//!
//! [`authority`] issues, renews and revokes; [`router`] makes zenohd's configuration from the table of roles in
//! [`wire::access`]; [`tokens`] are for clients that have no certificate.

pub mod authority;
mod identities;
pub mod router;
pub mod tokens;

pub use authority::Authority;
pub use identities::{Identities, Identity};
