//! Random numbers from the operating system, for ids that must not repeat after a restart.

use ztl_core::TaskId;

/// A random number, from the clock if the system has no random source. Not for secrets.
pub(crate) fn number() -> u64 {
    getrandom::u64().unwrap_or_else(|_| {
        let since = std::time::UNIX_EPOCH.elapsed().unwrap_or_default();
        u64::from(since.subsec_nanos()) << 32 | u64::from(std::process::id())
    })
}

/// 16 random bytes.
pub(crate) fn bytes() -> impl Iterator<Item = u8> {
    [number(), number()].into_iter().flat_map(u64::to_le_bytes)
}

/// Random bytes that nobody can guess, for keys of a connection.
///
/// # Panics
/// If the system has no random source.
pub(crate) fn secret() -> [u8; 32] {
    let mut bytes = [0; 32];
    #[expect(clippy::expect_used, reason = "a key that can be guessed is worse")]
    getrandom::fill(&mut bytes).expect("a random source");
    bytes
}

/// A nonzero random number.
pub(crate) fn nonzero() -> u32 {
    (number() as u32).max(1)
}

/// A server's first task id: 1 to 2^30, so that an id from before a restart does not name another task.
pub(crate) fn first_task_id() -> TaskId {
    let number = (number() as u32) & ((1 << 30) - 1);
    TaskId::new(number).unwrap_or(FIRST)
}

/// The lowest task id.
pub(crate) const FIRST: TaskId = match TaskId::new(1) {
    Some(id) => id,
    None => unreachable!(),
};
