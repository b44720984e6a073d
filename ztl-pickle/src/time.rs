//! Dates and times, in the bytes that Python's `datetime` puts into pickles.

use crate::Error;
use crate::global::Global;
use crate::graph::{Graph, Node, Ref};
use crate::input::malformed;

const DAY: i64 = 24 * 60 * 60 * 1_000_000;

/// `datetime.date`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Date {
    /// From 1 to 9999.
    pub year: u16,
    /// From 1 to 12.
    pub month: u8,
    /// From 1 to 31.
    pub day: u8,
}

/// `datetime.time`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Time<'a> {
    /// From 0 to 23.
    pub hour: u8,
    /// From 0 to 59.
    pub minute: u8,
    /// From 0 to 59.
    pub second: u8,
    /// Microseconds, from 0 to 999999.
    pub micros: u32,
    /// Set for the second pass, where a clock is put back.
    pub fold: bool,
    /// If it is known.
    pub zone: Option<TimeZone<'a>>,
}

/// `datetime.datetime`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct DateTime<'a> {
    /// The day.
    pub date: Date,
    /// The time of that day.
    pub time: Time<'a>,
}

/// `datetime.timedelta`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeDelta {
    /// Negative for any negative duration.
    pub days: i32,
    /// From 0 to 86399.
    pub seconds: u32,
    /// Microseconds, from 0 to 999999.
    pub micros: u32,
}

/// `datetime.timezone`
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct TimeZone<'a> {
    /// What is added to UTC; less than a day.
    pub offset: TimeDelta,
    /// If it has one.
    pub name: Option<&'a str>,
}

impl Date {
    fn parse([high, low, month, day]: [u8; 4]) -> Option<Self> {
        let year = u16::from_be_bytes([high, low]);
        let leap =
            year.is_multiple_of(4) && (!year.is_multiple_of(100) || year.is_multiple_of(400));
        let days = match month {
            4 | 6 | 9 | 11 => 30,
            2 if leap => 29,
            2 => 28,
            1..=12 => 31,
            _ => return None,
        };
        let valid = (1..=9999).contains(&year) && (1..=days).contains(&day);
        valid.then_some(Self { year, month, day })
    }

    /// Days since the first one, which has the number 1.
    fn ordinal(self) -> i64 {
        // The year begins in March, so that leap days come last.
        let (year, month) = (i64::from(self.year), i64::from(self.month));
        let (year, month) = if month < 3 {
            (year - 1, month + 9)
        } else {
            (year, month - 3)
        };
        year * 365 + year / 4 - year / 100
            + year / 400
            + (month * 153 + 2) / 5
            + i64::from(self.day)
            - 306
    }
}

impl<'a> Time<'a> {
    fn parse(state: [u8; 6], fold: bool, zone: Option<TimeZone<'a>>) -> Option<Self> {
        let [hour, minute, second, high, middle, low] = state;
        let micros = u32::from_be_bytes([0, high, middle, low]);
        let valid = hour < 24 && minute < 60 && second < 60 && micros < 1_000_000;
        valid.then_some(Self {
            hour,
            minute,
            second,
            micros,
            fold,
            zone,
        })
    }

    /// Microseconds since midnight, in UTC if the zone is known.
    pub(crate) fn micros(&self) -> i64 {
        let minutes = i64::from(self.hour) * 60 + i64::from(self.minute);
        let seconds = minutes * 60 + i64::from(self.second);
        let offset = self.zone.map_or(0, |zone| zone.offset.total_micros());
        seconds * 1_000_000 + i64::from(self.micros) - offset
    }
}

impl DateTime<'_> {
    /// Microseconds since the year 1, in UTC if the zone is known.
    pub(crate) fn micros(&self) -> i64 {
        self.date.ordinal() * DAY + self.time.micros()
    }
}

impl TimeDelta {
    /// All of it in microseconds; saturates at 292471 years.
    #[must_use]
    pub const fn total_micros(self) -> i64 {
        let rest = self.seconds as i64 * 1_000_000 + self.micros as i64;
        (self.days as i64).saturating_mul(DAY).saturating_add(rest)
    }
}

/// The node of a call, if its arguments are in Python's ranges.
pub(crate) fn call(graph: &Graph, global: Global, args: &[Ref]) -> Result<Node, Error> {
    let wrong = || malformed("an invalid date or time");
    let node = match (global, args) {
        (Global::Date, [state]) => {
            let state = start(graph, *state, 4);
            state.map(|state| Node::Date { state })
        }
        (Global::Time | Global::DateTime, [state, zone @ ..]) => {
            let zone = match zone {
                [] => Ref::NONE,
                [zone] if matches!(graph.node(*zone), Node::Zone { .. }) => *zone,
                _ => return Err(wrong()),
            };
            match global {
                Global::Time => start(graph, *state, 6).map(|state| Node::Time { state, zone }),
                _ => start(graph, *state, 10).map(|state| Node::DateTime { state, zone }),
            }
        }
        (Global::Delta, [days, seconds, micros]) => {
            let part = |part, range: std::ops::Range<i64>| match graph.node(part) {
                Node::Int(value) if range.contains(&value) => Some(value),
                _ => None,
            };
            let days = part(*days, -999_999_999..1_000_000_000);
            let seconds = part(*seconds, 0..86400);
            let micros = part(*micros, 0..1_000_000);
            days.zip(seconds)
                .zip(micros)
                .map(|((days, seconds), micros)| Node::Delta {
                    days: days as i32,
                    seconds: seconds as u32,
                    micros: micros as u32,
                })
        }
        (Global::Zone, [delta, name @ ..]) => {
            let name = match name {
                [] => Ref::NONE,
                [name] if text(graph, *name).is_some() => *name,
                _ => return Err(wrong()),
            };
            let within =
                self::delta(graph, *delta).is_some_and(|delta| delta.total_micros().abs() < DAY);
            within.then_some(Node::Zone {
                delta: *delta,
                name,
            })
        }
        _ => None,
    };
    let valid = node.filter(|node| match node {
        Node::Date { state } => date(graph, *state).is_some(),
        Node::Time { state, zone } => time(graph, *state, *zone).is_some(),
        Node::DateTime { state, zone } => datetime(graph, *state, *zone).is_some(),
        _ => true,
    });
    valid.ok_or_else(wrong)
}

/// Where the bytes of this length are; Python 2's are text if they are ASCII.
fn start(graph: &Graph, state: Ref, len: u32) -> Option<u32> {
    match graph.node(state) {
        Node::Bytes(span) | Node::Str(span) if span.len == len => Some(span.start),
        _ => None,
    }
}

fn text(graph: &Graph, name: Ref) -> Option<&str> {
    match graph.node(name) {
        Node::Str(span) => std::str::from_utf8(graph.bytes(span)).ok(),
        _ => None,
    }
}

pub(crate) fn date(graph: &Graph, state: u32) -> Option<Date> {
    Date::parse(graph.state(state))
}

pub(crate) fn time(graph: &Graph, state: u32, zone: Ref) -> Option<Time<'_>> {
    let [hour, rest @ ..]: [u8; 6] = graph.state(state);
    let [a, b, c, d, e] = rest;
    let fold = hour & 0x80 != 0;
    Time::parse([hour & 0x7f, a, b, c, d, e], fold, self::zone(graph, zone))
}

pub(crate) fn datetime(graph: &Graph, state: u32, zone: Ref) -> Option<DateTime<'_>> {
    let [year, low, month, day, rest @ ..]: [u8; 10] = graph.state(state);
    let fold = month & 0x80 != 0;
    Some(DateTime {
        date: Date::parse([year, low, month & 0x7f, day])?,
        time: Time::parse(rest, fold, self::zone(graph, zone))?,
    })
}

pub(crate) fn delta(graph: &Graph, delta: Ref) -> Option<TimeDelta> {
    match graph.node(delta) {
        Node::Delta {
            days,
            seconds,
            micros,
        } => Some(TimeDelta {
            days,
            seconds,
            micros,
        }),
        _ => None,
    }
}

pub(crate) fn zone(graph: &Graph, zone: Ref) -> Option<TimeZone<'_>> {
    match graph.node(zone) {
        Node::Zone { delta, name } => Some(TimeZone {
            offset: self::delta(graph, delta)?,
            name: text(graph, name),
        }),
        _ => None,
    }
}
