//! Certificates by role.
