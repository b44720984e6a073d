//! Random numbers.

/// A random number that is not 0; 1 where the system has none. Not for secrets.
pub(crate) fn random() -> u32 {
    getrandom::u32().map_or(1, |number| number.max(1))
}
