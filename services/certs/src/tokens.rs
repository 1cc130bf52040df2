//! Bearer tokens, for clients without a certificate.

use crate::authority::{AUTHORITY, Authority, check_identity};
use anyhow::{Context, ensure};
use service_kit::access::{TokenEntry, TokenFile, token_digest};
use service_kit::files;
use std::path::PathBuf;
use wire::access::Role;

/// Name of token files.
const TOKENS: &str = "tokens.json";
/// Largest token file, in bytes, as for the services that read it.
const MAX_BYTES: usize = 1 << 20;

impl Authority {
    /// Issues a token to an identity. Only its digest is stored, in the token files of planners and trainers.
    ///
    /// # Errors
    /// If the identity is malformed or was revoked, or a file cannot be read or written.
    pub fn issue_token(&mut self, identity: &str) -> anyhow::Result<String> {
        check_identity(identity)?;
        let known = self.identities().identities.get(identity);
        let revoked = known.is_some_and(|known| known.revoked.is_some());
        ensure!(!revoked, "identity: expected one that was not revoked, got {identity}");
        let token = hex::encode(rand::random::<[u8; 32]>());
        let mut file = self.read_tokens()?;
        file.tokens.push(TokenEntry { identity: identity.to_owned(), sha256: token_digest(&token) });
        self.write_tokens(&file)?;
        Ok(token)
    }

    /// Revokes all tokens of an identity, and returns their number.
    ///
    /// # Errors
    /// If a file cannot be read or written.
    pub fn revoke_tokens(&mut self, identity: &str) -> anyhow::Result<usize> {
        let mut file = self.read_tokens()?;
        let before = file.tokens.len();
        file.tokens.retain(|entry| entry.identity != identity);
        self.write_tokens(&file)?;
        Ok(before - file.tokens.len())
    }

    /// Writes the token file, even if empty, into the folders of planners and trainers.
    ///
    /// # Errors
    /// If a file cannot be read or written.
    pub fn lay_tokens(&self) -> anyhow::Result<()> {
        self.write_tokens(&self.read_tokens()?)
    }

    fn token_list(&self) -> PathBuf {
        self.folder(AUTHORITY).join(TOKENS)
    }

    fn read_tokens(&self) -> anyhow::Result<TokenFile> {
        let list = self.token_list();
        if !list.exists() {
            return Ok(TokenFile::default());
        }
        let bytes = files::read_all(&list, MAX_BYTES).with_context(|| list.display().to_string())?;
        serde_json::from_slice(&bytes).with_context(|| list.display().to_string())
    }

    fn write_tokens(&self, file: &TokenFile) -> anyhow::Result<()> {
        let text = serde_json::to_vec_pretty(file)?;
        let length = text.len();
        ensure!(length <= MAX_BYTES, "tokens: expected at most {MAX_BYTES} bytes of them, got {length}; revoke some");
        files::write_secret(&self.token_list(), &text)?;
        for (identity, known) in &self.identities().identities {
            let serves = matches!(Role::of(identity), Some(Role::Planner | Role::Trainer));
            if serves && known.revoked.is_none() {
                files::write_secret(&self.folder(identity).join(TOKENS), &text)?;
            }
        }
        Ok(())
    }
}
