//! Random ids.

use ztl_core::envelope::ClientId;

use crate::seal::{NONCE, Nonce};

/// 16 random bytes.
///
/// # Errors
/// If the system has no random source.
pub fn id() -> Result<ClientId, getrandom::Error> {
    let mut bytes = [0; 16];
    getrandom::fill(&mut bytes)?;
    Ok(ClientId(bytes))
}

/// A boot id, never 0.
///
/// # Errors
/// If the system has no random source.
pub fn boot() -> Result<u32, getrandom::Error> {
    Ok(getrandom::u32()?.max(1))
}

/// A random nonce.
///
/// # Errors
/// If the system has no random source.
pub fn nonce() -> Result<Nonce, getrandom::Error> {
    let mut bytes = [0; NONCE];
    getrandom::fill(&mut bytes)?;
    Ok(bytes)
}
