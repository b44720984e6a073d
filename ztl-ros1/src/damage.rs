//! Damaged input for tests of parsers: the same in each run.

/// Calls `parse` with versions of these bytes in which some are changed and the end may be missing.
pub(crate) fn damage(bytes: &[u8], mut parse: impl FnMut(&[u8])) {
    let mut state = 0x2545_F491_u32;
    for round in 0..20_000 {
        let mut damaged = bytes.to_vec();
        for _ in 0..=round % 4 {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let at = (state >> 8) as usize % damaged.len();
            damaged[at] = (state >> 24) as u8;
            damaged.truncate(damaged.len() - (state >> 16) as usize % 3);
        }
        parse(&damaged);
    }
}
