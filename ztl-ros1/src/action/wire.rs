//! The messages of actionlib around the bytes of a goal, a feedback and a result.

use std::borrow::Cow;

use crate::WireType;

/// `actionlib_msgs/GoalID`, the type of the topic `cancel`.
pub(crate) fn cancel_type() -> WireType {
    WireType {
        name: "actionlib_msgs/GoalID".to_owned(),
        md5: "302881f31927c1df708a2dbab0e80ee8".to_owned(),
        definition: "time stamp\nstring id\n".to_owned(),
    }
}

/// `actionlib_msgs/GoalStatusArray`, the type of the topic `status`.
pub(crate) fn status_type() -> WireType {
    WireType {
        name: STATUS_TYPE.to_owned(),
        md5: "8b2b82f13216d0a8ea88bd3af735e619".to_owned(),
        definition: String::new(),
    }
}

pub(crate) const STATUS_TYPE: &str = "actionlib_msgs/GoalStatusArray";

/// A time of ROS. Zero if the clock is not known yet.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub(crate) struct RosTime {
    pub(crate) secs: u32,
    pub(crate) nsecs: u32,
}

/// The states of `actionlib_msgs/GoalStatus`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Status {
    Pending,
    Active,
    Preempted,
    Succeeded,
    Aborted,
    Rejected,
    Preempting,
    Recalling,
    Recalled,
    /// LOST, which no server may say, or another number.
    Other(u8),
}

impl Status {
    fn new(number: u8) -> Self {
        match number {
            0 => Self::Pending,
            1 => Self::Active,
            2 => Self::Preempted,
            3 => Self::Succeeded,
            4 => Self::Aborted,
            5 => Self::Rejected,
            6 => Self::Preempting,
            7 => Self::Recalling,
            8 => Self::Recalled,
            other => Self::Other(other),
        }
    }
}

/// What a server says of a goal.
#[derive(Debug, Clone, PartialEq, Eq)]
pub(crate) struct GoalStatus<'a> {
    pub(crate) id: Cow<'a, str>,
    pub(crate) status: Status,
    pub(crate) text: Cow<'a, str>,
}

/// A message of the topic `goal`.
pub(crate) fn goal(seq: u32, stamp: RosTime, id: &str, content: &[u8]) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(28 + id.len() + content.len());
    bytes.extend(seq.to_le_bytes());
    put_time(stamp, &mut bytes);
    put_string("", &mut bytes);
    put_time(stamp, &mut bytes);
    put_string(id, &mut bytes);
    bytes.extend_from_slice(content);
    bytes
}

/// A message of the topic `cancel` for one goal.
pub(crate) fn cancel(id: &str) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(12 + id.len());
    // Without a time, it cancels nothing but this goal.
    put_time(RosTime::default(), &mut bytes);
    put_string(id, &mut bytes);
    bytes
}

/// Reads a message of the topic `status`.
pub(crate) fn parse_status(bytes: &[u8]) -> Option<Vec<GoalStatus<'_>>> {
    let mut rest = skip_header(bytes)?;
    let count = take_u32(&mut rest)?;
    // Not more than there can be: a status has at least 17 bytes.
    let mut found = Vec::with_capacity((count as usize).min(rest.len() / 17));
    for _ in 0..count {
        found.push(take_status(&mut rest)?);
    }
    Some(found)
}

/// Reads a message of the topic `feedback` or `result`: the goal's status, and the encoded content.
pub(crate) fn parse_update(bytes: &[u8]) -> Option<(GoalStatus<'_>, &[u8])> {
    let mut rest = skip_header(bytes)?;
    let status = take_status(&mut rest)?;
    Some((status, rest))
}

/// Reads a message of the topic `/clock`.
pub(crate) fn parse_clock(mut bytes: &[u8]) -> Option<RosTime> {
    Some(RosTime {
        secs: take_u32(&mut bytes)?,
        nsecs: take_u32(&mut bytes)?,
    })
}

fn put_time(time: RosTime, bytes: &mut Vec<u8>) {
    bytes.extend(time.secs.to_le_bytes());
    bytes.extend(time.nsecs.to_le_bytes());
}

fn put_string(text: &str, bytes: &mut Vec<u8>) {
    bytes.extend(u32::try_from(text.len()).unwrap_or(u32::MAX).to_le_bytes());
    bytes.extend_from_slice(text.as_bytes());
}

fn skip_header(bytes: &[u8]) -> Option<&[u8]> {
    let mut rest = bytes.get(12..)?;
    take_string(&mut rest)?;
    Some(rest)
}

fn take_status<'a>(rest: &mut &'a [u8]) -> Option<GoalStatus<'a>> {
    *rest = rest.get(8..)?;
    let id = take_string(rest)?;
    let (status, after) = rest.split_first()?;
    *rest = after;
    Some(GoalStatus {
        id,
        status: Status::new(*status),
        text: take_string(rest)?,
    })
}

fn take_u32(rest: &mut &[u8]) -> Option<u32> {
    let (bytes, after) = rest.split_first_chunk::<4>()?;
    *rest = after;
    Some(u32::from_le_bytes(*bytes))
}

fn take_string<'a>(rest: &mut &'a [u8]) -> Option<Cow<'a, str>> {
    let len = usize::try_from(take_u32(rest)?).ok()?;
    let (text, after) = rest.split_at_checked(len)?;
    *rest = after;
    Some(String::from_utf8_lossy(text))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A header as a server writes it, with a frame.
    const HEADER: &[u8] = b"\x05\0\0\0\x01\0\0\0\x02\0\0\0\x01\0\0\0f";
    const ONE: &[u8] = b"\0\0\0\0\0\0\0\0\x02\0\0\0ab\x03\x04\0\0\0done";

    fn done() -> GoalStatus<'static> {
        GoalStatus {
            id: "ab".into(),
            status: Status::Succeeded,
            text: "done".into(),
        }
    }

    #[test]
    fn what_servers_send_is_read() {
        let bytes = [HEADER, b"\x02\0\0\0", ONE, ONE].concat();
        assert_eq!(parse_status(&bytes), Some(vec![done(), done()]));
        let bytes = [HEADER, ONE, b"rest"].concat();
        assert_eq!(parse_update(&bytes), Some((done(), &b"rest"[..])));
        for end in 0..bytes.len() - 4 {
            assert_eq!(parse_update(&bytes[..end]), None, "{end}");
        }
        let bytes = [HEADER, b"\xff\xff\xff\xff", ONE].concat();
        assert_eq!(parse_status(&bytes), None);
    }

    #[test]
    fn no_damage_panics() {
        let bytes = [HEADER, b"\x02\0\0\0", ONE, ONE].concat();
        crate::damage::damage(&bytes, |damaged| {
            let _ = parse_status(damaged);
            let _ = parse_update(damaged);
            let _ = parse_clock(damaged);
        });
    }

    #[test]
    fn goals_and_cancels_have_the_layout_of_their_types() {
        let stamp = RosTime { secs: 1, nsecs: 2 };
        let expected =
            b"\x09\0\0\0\x01\0\0\0\x02\0\0\0\0\0\0\0\x01\0\0\0\x02\0\0\0\x02\0\0\0abgoal";
        assert_eq!(goal(9, stamp, "ab", b"goal"), expected);
        assert_eq!(cancel("ab"), b"\0\0\0\0\0\0\0\0\x02\0\0\0ab");
    }
}
