//! Durations as text, and their statistics.

use std::time::Duration;

/// Seconds with milliseconds: `1.523`.
pub(crate) fn seconds(time: Duration) -> String {
    let millis = (time.as_micros() + 500) / 1000;
    format!("{}.{:03}", millis / 1000, millis % 1000)
}

/// A difference in seconds, with its sign: `+1.523`.
pub(crate) fn difference(to: Duration, from: Duration) -> String {
    match to.checked_sub(from) {
        Some(more) => format!("+{}", seconds(more)),
        None => format!("−{}", seconds(from.saturating_sub(to))),
    }
}

/// Milliseconds with microseconds: `1.523`.
pub(crate) fn millis(time: Duration) -> String {
    let micros = time.as_micros();
    format!("{}.{:03}", micros / 1000, micros % 1000)
}

/// Short text for people: `0.82 s`, `1 min 05 s`, `1 h 02 min`.
pub(crate) fn spoken(time: Duration) -> String {
    let whole = time.as_secs();
    match whole {
        0..60 => format!("{:.2} s", time.as_secs_f64()),
        60..3600 => format!("{} min {:02} s", whole / 60, whole % 60),
        _ => format!("{} h {:02} min", whole / 3600, whole % 3600 / 60),
    }
}

/// The nearest-rank percentile. 50 percent of an even count is the mean of the two middle values: the
/// median.
pub(crate) fn percentile(values: &[Duration], percent: usize) -> Option<Duration> {
    let mut sorted = values.to_vec();
    sorted.sort_unstable();
    let rank = (sorted.len() * percent).div_ceil(100).max(1);
    let value = *sorted.get(rank - 1)?;
    if percent == 50 && sorted.len().is_multiple_of(2) {
        return Some((value + *sorted.get(rank)?) / 2);
    }
    Some(value)
}

/// The median.
pub(crate) fn median(values: &[Duration]) -> Option<Duration> {
    percentile(values, 50)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(millis: &[u64]) -> Vec<Duration> {
        millis.iter().copied().map(Duration::from_millis).collect()
    }

    #[test]
    fn the_median_of_an_even_count_is_the_mean_of_the_middle_two() {
        assert_eq!(median(&of(&[])), None);
        assert_eq!(median(&of(&[7])), Some(Duration::from_millis(7)));
        assert_eq!(median(&of(&[9, 1, 5])), Some(Duration::from_millis(5)));
        assert_eq!(median(&of(&[4, 1, 8, 2])), Some(Duration::from_millis(3)));
    }

    #[test]
    fn the_95th_of_a_hundred_is_the_95th() {
        let all: Vec<u64> = (1..=100).rev().collect();
        assert_eq!(percentile(&of(&all), 95), Some(Duration::from_millis(95)));
        assert_eq!(percentile(&of(&[3]), 95), Some(Duration::from_millis(3)));
        assert_eq!(percentile(&of(&[3, 4]), 95), Some(Duration::from_millis(4)));
    }

    #[test]
    fn times_are_rounded() {
        assert_eq!(seconds(Duration::from_micros(1_999_500)), "2.000");
        assert_eq!(
            difference(Duration::from_millis(1), Duration::from_millis(3)),
            "−0.002"
        );
        assert_eq!(spoken(Duration::from_secs(65)), "1 min 05 s");
    }
}
