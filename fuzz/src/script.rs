//! Scenarios as text, one step per line, so that people can read and write corpus files and findings.

/// Longest scenario in steps; enough to fill every table many times.
const MOST_STEPS: usize = 200;

/// The steps: a verb and its argument. Skips empty lines and comments (`#`).
pub fn steps(script: &[u8]) -> impl Iterator<Item = (u8, &[u8])> {
    script
        .split(|&byte| byte == b'\n')
        .filter_map(|line| line.split_first())
        .filter(|(verb, _)| **verb != b'#')
        .map(|(verb, rest)| (*verb, rest))
        .take(MOST_STEPS)
}

/// Consumes leading digits and one space after them; no digits give 0.
pub fn number(rest: &mut &[u8]) -> u64 {
    let digits = rest.iter().take_while(|byte| byte.is_ascii_digit()).count();
    let (number, after) = rest.split_at(digits);
    *rest = after.strip_prefix(b" ").unwrap_or(after);
    number.iter().fold(0u64, |number, digit| {
        number
            .saturating_mul(10)
            .saturating_add(u64::from(digit - b'0'))
    })
}

/// The item with this index, modulo the length; `None` if there are none.
pub fn pick<T>(items: &[T], number: u64) -> Option<&T> {
    let count = u64::try_from(items.len()).ok()?;
    items.get(usize::try_from(number.checked_rem(count)?).ok()?)
}

/// As text; invalid UTF-8 becomes the replacement character.
pub fn text(bytes: &[u8]) -> String {
    String::from_utf8_lossy(bytes).into_owned()
}
