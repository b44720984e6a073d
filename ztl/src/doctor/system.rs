//! Checks the machine: kernel, processor, memory, clocks, random numbers, open files.

use std::fs;
use std::time::{Duration, Instant, SystemTime, UNIX_EPOCH};

use nix::libc::RLIM_INFINITY;
use nix::sys::resource::{Resource, getrlimit};
use serde_json::json;

use super::finding::Finding;
use crate::{kernel, version};

/// A clock before this was never set.
const YOUNGEST: u64 = 1_704_067_200; // 2024-01-01

/// How long to watch the monotonic clock.
const WATCH: Duration = Duration::from_millis(60);

pub(super) fn kernel() -> Finding {
    let name = rustix::system::uname();
    let release = name.release().to_string_lossy();
    let text = format!(
        "{} {release} on {}",
        name.sysname().to_string_lossy(),
        name.machine().to_string_lossy()
    );
    let data = json!({ "release": release, "machine": name.machine().to_string_lossy() });
    match kernel::too_old(&release) {
        Some(mistake) => Finding::problem(
            "kernel",
            format!("{text}: {mistake}"),
            "run ztl on a newer machine next to this one",
        ),
        None => Finding::good("kernel", text),
    }
    .with(data)
}

pub(super) fn processor() -> Finding {
    let Ok(text) = fs::read_to_string("/proc/cpuinfo") else {
        return Finding::note("cpu", "cannot read /proc/cpuinfo")
            .with_remedy("mount -t proc proc /proc");
    };
    let value = |keys: &[&str]| {
        let mut pairs = text.lines().filter_map(|line| line.split_once(':'));
        let found = pairs.find(|(key, _)| keys.contains(&key.trim()));
        found.map(|(_, value)| value.trim().to_owned())
    };
    let model = value(&["model name", "Model", "Processor", "Hardware", "cpu model"]);
    let features = value(&["flags", "Features"]).unwrap_or_default();
    let has = |name: &str| features.split_whitespace().any(|feature| feature == name);
    let known = [
        "sse2", "ssse3", "aes", "avx2", "vfp", "vfpv3", "neon", "asimd", "crc32", "edsp",
    ];
    let known: Vec<&str> = known.into_iter().filter(|name| has(name)).collect();
    let count = std::thread::available_parallelism().map_or(1, usize::from);
    let text = format!(
        "{}, {count} available; {}",
        model.unwrap_or_else(|| "unknown model".to_owned()),
        match known.as_slice() {
            [] => "no relevant features".to_owned(),
            some => some.join(" "),
        }
    );
    // A program for a newer processor would probably crash before this, but not always.
    let lacking = match version::target().split('-').next().unwrap_or_default() {
        "i686" if !has("sse2") => Some(("sse2", "i586")),
        "armv7" if !has("vfpv3") && !has("vfpv3d16") && !has("asimd") => Some(("vfpv3", "arm")),
        "arm" if !has("vfp") && !has("asimd") => Some(("vfp", "armv5te")),
        _ => None,
    };
    let data =
        json!({ "features": features.split_whitespace().collect::<Vec<_>>(), "count": count });
    match lacking {
        Some((feature, other)) if !features.is_empty() => Finding::problem(
            "cpu",
            format!("{text}: lacks {feature}, which this program requires"),
            format!("use the program for {other}"),
        ),
        _ => Finding::good("cpu", text),
    }
    .with(data)
}

pub(super) fn memory() -> Finding {
    let text = fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let kib = |key: &str| {
        let line = text.lines().find_map(|line| line.strip_prefix(key))?;
        line.split_whitespace().next()?.parse::<u64>().ok()
    };
    // Kernels before 3.14 have no `MemAvailable`.
    let estimate = || Some(kib("MemFree:")? + kib("Cached:")?);
    let Some((total, left)) = kib("MemTotal:").zip(kib("MemAvailable:").or_else(estimate)) else {
        return Finding::note("memory", "cannot read /proc/meminfo")
            .with_remedy("mount -t proc proc /proc");
    };
    let said = format!("{} MiB of {} MiB free", left / 1024, total / 1024);
    let data = json!({ "free_kib": left, "total_kib": total });
    if left < 16 * 1024 {
        let remedy = "stop the largest programs: `ps -eo rss,args | sort -n`";
        return Finding::problem("memory", said, remedy).with(data);
    }
    Finding::good("memory", said).with(data)
}

pub(super) fn wall_clock() -> Finding {
    let now = SystemTime::now();
    let seconds = now
        .duration_since(UNIX_EPOCH)
        .map_or(0, |since| since.as_secs());
    let text = humantime::format_rfc3339_seconds(now).to_string();
    let data = json!({ "unix_s": seconds });
    if seconds < YOUNGEST {
        return Finding::problem(
            "clock",
            format!("reads {text}: not set since the machine started"),
            "run `date -s '2026-01-31 12:00'` or ntpd; tasks do not depend on this clock, but logs, journals and records do",
        )
        .with(data);
    }
    Finding::good("clock", text).with(data)
}

/// The clock of tasks, links and timeouts.
pub(super) fn monotonic_clock() -> Finding {
    use rustix::time::{ClockId, clock_getres, clock_gettime};
    let nanos = |time: rustix::time::Timespec| {
        i128::from(time.tv_sec) * 1_000_000_000 + i128::from(time.tv_nsec)
    };
    let begin = (Instant::now(), SystemTime::now());
    let mut last = nanos(clock_gettime(ClockId::Monotonic));
    let (mut back, mut longest) = (0, 0);
    while begin.0.elapsed() < WATCH && begin.1.elapsed().is_ok_and(|passed| passed < 10 * WATCH) {
        let now = nanos(clock_gettime(ClockId::Monotonic));
        back += u32::from(now < last);
        longest = longest.max(now - last);
        last = now;
    }
    let resolution = nanos(clock_getres(ClockId::Monotonic));
    let source = "/sys/devices/system/clocksource/clocksource0/current_clocksource";
    let source = fs::read_to_string(source).unwrap_or_default();
    let source = match source.trim() {
        "" => String::new(),
        name => format!(", from {name}"),
    };
    let text = format!(
        "monotonic, resolution {} us{source}; longest pause of this program in {} ms: {} us",
        (resolution + 999) / 1000,
        WATCH.as_millis(),
        longest / 1000
    );
    let data = json!({
        "resolution_ns": i64::try_from(resolution).unwrap_or(i64::MAX),
        "longest_pause_us": i64::try_from(longest / 1000).unwrap_or(i64::MAX),
        "steps_back": back,
    });
    if back > 0 {
        return Finding::problem(
            "timer",
            format!("the monotonic clock went back {back} times"),
            "use another clock source: boot with `clocksource=hpet` or `clocksource=acpi_pm`",
        )
        .with(data);
    }
    if resolution > 1_000_000 {
        return Finding::note("timer", text)
            .with_remedy(
                "use a kernel with high-resolution timers; without them, commands over links are resent late",
            )
            .with(data);
    }
    Finding::good("timer", text).with(data)
}

/// Ids of tasks and sessions are random. Shortly after boot there may be no random numbers yet.
pub(super) fn randomness() -> Finding {
    let begin = Instant::now();
    let mut bytes = [0; 16];
    match getrandom::fill(&mut bytes) {
        Ok(()) if begin.elapsed() < Duration::from_secs(1) => {
            Finding::good("random", "random numbers are available")
        }
        Ok(()) => Finding::note(
            "random",
            format!(
                "waited {:.1} s for random numbers",
                begin.elapsed().as_secs_f32()
            ),
        )
        .with_remedy("start servers later in the boot process, or install haveged"),
        Err(error) => Finding::problem(
            "random",
            format!("no random numbers: {error}"),
            "run `mknod -m 666 /dev/random c 1 8; mknod -m 666 /dev/urandom c 1 9`: kernels before 3.17 need these files",
        ),
    }
}

/// Each connection takes one open file.
pub(super) fn files() -> Finding {
    // Not by rustix: it needs `prlimit64` of Linux 2.6.36, and without it returns anything.
    let limits = getrlimit(Resource::RLIMIT_NOFILE);
    let limit = limits.map_or(None, |(soft, _)| (soft != RLIM_INFINITY).then_some(soft));
    let text = match limit {
        Some(limit) => format!("up to {limit} open files"),
        None => "no limit on open files".to_owned(),
    };
    let data = json!({ "limit": limit });
    if limit.is_some_and(|limit| limit < 256) {
        let remedy = "run `ulimit -n 1024` before starting a server; each client takes one";
        return Finding::problem("files", text, remedy).with(data);
    }
    Finding::good("files", text).with(data)
}
