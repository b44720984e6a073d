//! Dates and times as Python's `repr` prints them.

use std::fmt::{self, Write};

use super::put_str;
use crate::time::{Date, Time, TimeDelta, TimeZone};

pub(super) fn put_date(Date { year, month, day }: Date, out: &mut impl Write) -> fmt::Result {
    write!(out, "{year}, {month}, {day}")
}

pub(super) fn put_time(time: Time<'_>, out: &mut impl Write) -> fmt::Result {
    write!(out, "{}, {}", time.hour, time.minute)?;
    if time.second != 0 || time.micros != 0 {
        write!(out, ", {}", time.second)?;
    }
    if time.micros != 0 {
        write!(out, ", {}", time.micros)?;
    }
    Ok(())
}

pub(super) fn put_zone(zone: Option<TimeZone<'_>>, out: &mut impl Write) -> fmt::Result {
    let Some(zone) = zone else {
        return Ok(());
    };
    out.write_str(", tzinfo=")?;
    put_timezone(zone, out)
}

pub(super) fn put_timezone(zone: TimeZone<'_>, out: &mut impl Write) -> fmt::Result {
    if zone.name.is_none() && zone.offset.total_micros() == 0 {
        return out.write_str("datetime.timezone.utc");
    }
    out.write_str("datetime.timezone(")?;
    put_delta(zone.offset, out)?;
    if let Some(name) = zone.name {
        out.write_str(", ")?;
        put_str(name, out)?;
    }
    out.write_char(')')
}

pub(super) fn put_delta(delta: TimeDelta, out: &mut impl Write) -> fmt::Result {
    let parts = [
        ("days", i64::from(delta.days)),
        ("seconds", delta.seconds.into()),
        ("microseconds", delta.micros.into()),
    ];
    out.write_str("datetime.timedelta(")?;
    let mut separator = "";
    for (name, value) in parts.into_iter().filter(|(_, value)| *value != 0) {
        write!(out, "{separator}{name}={value}")?;
        separator = ", ";
    }
    out.write_str(if separator.is_empty() { "0)" } else { ")" })
}
