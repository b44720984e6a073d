//! Times and sizes for people.

use std::time::Duration;

pub(crate) fn human_time(time: Duration) -> String {
    match time.as_millis() {
        millis if millis % 1000 == 0 => format!("{} s", millis / 1000),
        millis => format!("{millis} ms"),
    }
}

pub(crate) fn human_size(bytes: usize) -> String {
    match bytes {
        bytes if bytes % 1024 == 0 => format!("{} KiB", bytes / 1024),
        bytes => format!("{bytes} bytes"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_and_sizes_have_their_largest_whole_unit() {
        assert_eq!(human_size(64 * 1024), "64 KiB");
        assert_eq!(human_size(1000), "1000 bytes");
        assert_eq!(human_time(Duration::from_secs(2)), "2 s");
        assert_eq!(human_time(Duration::from_millis(300)), "300 ms");
    }
}
