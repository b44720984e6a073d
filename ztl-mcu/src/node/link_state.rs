//! The state of a node's end of the link.

use ztl_core::Instant;
use ztl_core::link::LinkId;

use super::frame_out::FrameOut;
use super::refusal::Refusal;
use super::runner::TaskRunner;

/// The link while it is up: firmware shows it, or lets a button work only without a gateway.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct LinkUp {
    /// The number of the gateway. Each gateway has its own, which stays the same when it restarts.
    pub gateway: u64,
    /// When its first command after a loss, or after the node's reset, was executed. A new session of the same gateway
    /// within the link timeout changes nothing.
    pub since: Instant,
}

/// Statistics of the line since boot; the counts wrap around.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default)]
#[non_exhaustive]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Counters {
    /// Frames with a valid checksum.
    pub frames: u32,
    /// Frames dropped: damaged, of another session, or too long.
    pub errors: u32,
    /// Repeated commands, answered again without being executed again.
    pub repeats: u32,
    /// Commands out of sequence, dropped.
    pub out_of_sequence: u32,
    /// When the link came up last.
    pub(super) up_since: Instant,
}

pub(super) fn count(counter: &mut u32) {
    *counter = counter.wrapping_add(1);
}

/// The answer to the last command, kept in case the command is repeated.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Answer {
    /// There was no command.
    Nothing,
    Welcome,
    /// To a `Describe` with this index, of a component or of a part of the descriptions.
    Component(u8),
    Started(LinkId),
    Refused(Refusal),
    Aborting(LinkId),
    Pong,
    /// To a command about the parameter with this number.
    Parameter(u8),
    Other(Other),
}

/// Answers that only nodes with parameters or updates give.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
pub(super) enum Other {
    /// All parameters are saved.
    Saved,
    /// To a question for what runs.
    Firmware,
    /// To any other command about updates.
    Update,
}

/// Everything but the decoder, whose buffer a received frame borrows while it is handled.
// Small fields come first, where one instruction of a Cortex-M0 reaches them. With the attribute of
// `Node::handle_bytes`, this saves 232 bytes in `microbit-quiet`.
#[derive(Debug, Clone, PartialEq, Eq, Hash)]
#[repr(C)]
pub(super) struct LinkState<'a, C, const TASKS: usize, const FRAME: usize> {
    /// Sequence number of the last command executed.
    pub(super) seq: u8,
    pub(super) answer_due: bool,
    /// A delimiter was sent before the next announcement.
    pub(super) flushed: bool,
    /// The component that is asked for a reading next; each round asks every component once.
    pub(super) publisher: u8,
    /// Whether a component had a reading in this round.
    pub(super) published: bool,
    /// The current session; [`NO_SESSION`](ztl_core::link::NO_SESSION) after a reset.
    pub(super) session: u32,
    /// The number in the `Hello` that opened the session.
    pub(super) hello: u32,
    /// The number in the `Hello` of the session before.
    pub(super) replaced: u32,
    pub(super) highest: LinkId,
    pub(super) answer: Answer,
    pub(super) gateway: u64,
    /// In µs.
    pub(super) link_timeout: u64,
    pub(super) awake_due: Instant,
    /// When a new command was last executed, or a session opened. No other gateway is admitted until the link
    /// timeout has passed since.
    pub(super) heard: Instant,
    /// When the link timer expires: the link timeout after the last new command was executed.
    /// [`Instant::NEVER`] once it has expired.
    pub(super) lost_at: Instant,
    /// Until when the bytes in the decoder count as the start of a command.
    pub(super) receiving: Instant,
    /// When the reading interval allows the next round of readings; [`Instant::NEVER`] if no component publishes.
    pub(super) readings_at: Instant,
    /// In µs.
    pub(super) reading_interval: u64,
    /// A `Hello` to refuse: its session, and why.
    pub(super) refusal: Option<(u32, Refusal)>,
    pub(super) name: &'a str,
    pub(super) firmware: &'a str,
    pub(super) boot: u32,
    pub(super) runner: TaskRunner<C, TASKS>,
    pub(super) frame_out: FrameOut<FRAME>,
}
