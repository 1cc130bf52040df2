//! Certificate authority of one network: certificates and tokens by role, and the router's configuration.
//!
//! [`authority`] issues, renews and revokes certificates; [`router`] derives zenohd's configuration from the table of roles in
//! [`wire::access`]; [`tokens`] are for clients without a certificate.

pub mod authority;
mod identities;
pub mod router;
pub mod tokens;

pub use authority::Authority;
pub use identities::{Identities, Identity};
