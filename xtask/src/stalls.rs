//! Measures whether the machine stalls: a thread that sleeps for 10 ms and wakes much later, or processor time that the
//! host of a virtual machine takes away.

use std::fmt;
use std::fs;
use std::sync::{Arc, Mutex, PoisonError};
use std::thread;
use std::time::{Duration, Instant};

const SLEEP: Duration = Duration::from_millis(10);

/// A thread of a busy machine with 2 cores wakes within some 50 ms.
const LONG: Duration = Duration::from_millis(200);

/// Part of the processor time that the host may take.
const STOLEN: f64 = 0.1;

/// The longest wait of most tests is shorter.
const RECENT: Duration = Duration::from_secs(60);

/// A measurement that runs until it is dropped.
pub(crate) struct Stalls(Arc<Mutex<Vec<Second>>>);

/// What was measured in about one second.
#[derive(Clone, Copy)]
struct Second {
    end: Instant,
    /// How late the thread woke at most.
    late: Duration,
    /// Processor time since the system began: all of it and the part that the host took.
    time: ProcessorTime,
}

#[derive(Clone, Copy, Default)]
struct ProcessorTime {
    total: u64,
    stolen: u64,
}

impl Stalls {
    pub(crate) fn measure() -> Self {
        let seconds = Arc::new(Mutex::new(Vec::new()));
        let weak = Arc::downgrade(&seconds);
        thread::spawn(move || {
            while let Some(seconds) = weak.upgrade() {
                drop(seconds);
                let second = Second::measure();
                if let Some(seconds) = weak.upgrade() {
                    let mut seconds = seconds.lock().unwrap_or_else(PoisonError::into_inner);
                    seconds.push(second);
                }
            }
        });
        Self(seconds)
    }

    /// Whether the machine stalled in the last minute.
    pub(crate) fn were_recent(&self) -> bool {
        let now = Instant::now();
        let seconds = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let old = seconds.partition_point(|second| now - second.end > RECENT);
        let (late, stolen) = worst(seconds.get(old..).unwrap_or_default());
        late > LONG || stolen > STOLEN
    }
}

impl Second {
    fn measure() -> Self {
        let begin = Instant::now();
        let mut late = Duration::ZERO;
        let mut end = begin;
        while end - begin < Duration::from_secs(1) {
            thread::sleep(SLEEP);
            let now = Instant::now();
            late = late.max((now - end).saturating_sub(SLEEP));
            end = now;
        }
        let stat = fs::read_to_string("/proc/stat").unwrap_or_default();
        let time = ProcessorTime::read(&stat).unwrap_or_default();
        Self { end, late, time }
    }
}

impl ProcessorTime {
    /// Reads Linux' `/proc/stat`: `cpu user nice system idle iowait irq softirq steal …`.
    fn read(stat: &str) -> Option<Self> {
        let fields = stat.lines().next()?.strip_prefix("cpu ")?;
        let fields = fields.split_whitespace().take(8).map(str::parse);
        let fields: Vec<u64> = fields.collect::<Result<_, _>>().ok()?;
        Some(Self {
            total: fields.iter().sum(),
            stolen: *fields.get(7)?,
        })
    }
}

/// The longest delay, and the part of the processor time that the host took.
fn worst(seconds: &[Second]) -> (Duration, f64) {
    let late = seconds.iter().map(|second| second.late).max();
    let times = seconds.first().zip(seconds.last());
    let stolen = times.map_or(0.0, |(first, last)| {
        let total = last.time.total.saturating_sub(first.time.total);
        let stolen = last.time.stolen.saturating_sub(first.time.stolen);
        stolen as f64 / total.max(1) as f64
    });
    (late.unwrap_or_default(), stolen)
}

impl fmt::Display for Stalls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let seconds = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        let (late, stolen) = worst(&seconds);
        let stolen = stolen * 100.0;
        write!(
            f,
            "a stall of {late:.1?} at most, with {stolen:.0} % of the processor time taken by the host"
        )
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn second(late: u64, total: u64, stolen: u64) -> Second {
        Second {
            end: Instant::now(),
            late: Duration::from_millis(late),
            time: ProcessorTime { total, stolen },
        }
    }

    fn stalls(seconds: &[Second]) -> Stalls {
        Stalls(Arc::new(Mutex::new(seconds.to_vec())))
    }

    #[test]
    fn a_late_thread_and_stolen_time_are_stalls() {
        let quiet = second(50, 200, 10);
        assert!(!stalls(&[]).were_recent());
        assert!(!stalls(&[quiet, second(60, 400, 20)]).were_recent());
        assert!(stalls(&[quiet, second(210, 400, 20)]).were_recent());
        assert!(stalls(&[quiet, second(60, 400, 40)]).were_recent());
    }

    #[test]
    fn steal_is_the_eighth_field() {
        let stat = "cpu  10 0 5 80 1 0 1 3 0 0\ncpu0 1 2 3\n";
        let time = ProcessorTime::read(stat).expect("a line of Linux");
        assert_eq!((time.total, time.stolen), (100, 3));
    }
}
