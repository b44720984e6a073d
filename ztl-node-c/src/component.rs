//! A component in C, as the node uses it.

use core::ffi::{c_char, c_int, c_uchar, c_uint, c_void};
use core::time::Duration;

use ztl_mcu::link::{Busy, GoalShape, Loss, Offer};
use ztl_mcu::{Instant, Reading, Refused, Run};

use crate::report::Report;
use crate::text::{is_text, text};
use crate::{
    ZTL_NODE_ABORTED, ZTL_NODE_COMPLETED, ZTL_NODE_E_NULL, ZTL_NODE_E_POLICY, ZTL_NODE_E_TEXT,
    ZTL_NODE_FAILED, ZTL_NODE_FRAME, ZTL_NODE_LOSS_ABORT, ZTL_NODE_LOSS_CARRY_ON,
    ZTL_NODE_LOSS_HOLD, ZTL_NODE_REFUSE, ZTL_NODE_REPLACE, ZTL_NODE_TAKEN,
};

/// The time in milliseconds, as C uses it.
fn millis(now: Instant) -> u32 {
    now.as_millis() as u32
}

/// A part of the device that executes one task at a time. The firmware keeps it and everything it points to
/// unchanged while the node exists; a `static const` is best. The node calls its functions from within its
/// own. They must return quickly, because each is called between two bytes of the line.
#[repr(C)]
pub struct Component {
    /// Name that clients use. Not NULL.
    pub name: *const c_char,
    /// Words that it accepts as goals, separated by spaces, or NULL. For information only.
    pub words: *const c_char,
    /// Unit of the numbers that it accepts, or NULL. For information only.
    pub unit: *const c_char,
    /// Names under which it publishes readings, separated by spaces, or NULL.
    pub topics: *const c_char,
    /// Smallest number that it accepts; for information only.
    pub least: f32,
    /// Largest number that it accepts; equal to `least` if it accepts no numbers.
    pub most: f32,
    /// What happens to a second task: ZTL_NODE_REFUSE, ZTL_NODE_REPLACE, or how many may wait.
    pub busy: c_int,
    /// What it does when the link is lost: one of ZTL_NODE_LOSS_....
    pub loss: c_int,
    /// Interval between calls of `poll`, in milliseconds; 0 means 10.
    pub poll_ms: c_uint,
    /// Passed to each function; owned by the firmware, may be NULL.
    pub context: *mut c_void,
    /// Checks a goal without moving anything: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED. NULL accepts every goal,
    /// which `start` may still refuse. The goal belongs to the library and is valid during the call.
    pub check: Option<
        unsafe extern "C" fn(context: *mut c_void, goal: *const c_char, why: *mut Report) -> c_int,
    >,
    /// Starts a task whose goal was checked, while none is running: ZTL_NODE_TAKEN or ZTL_NODE_REFUSED. Not
    /// NULL. The goal belongs to the library and is valid during the call.
    pub start: Option<
        unsafe extern "C" fn(
            context: *mut c_void,
            now_ms: c_uint,
            goal: *const c_char,
            why: *mut Report,
        ) -> c_int,
    >,
    /// Advances the task and reports: ZTL_NODE_RUNNING, or its final state. After `make_safe` it is also called without a
    /// task: ZTL_NODE_RUNNING then means that the safe state is not reached yet, ZTL_NODE_FAILED that it needs another
    /// `make_safe`, any other value that it is reached. Further calls may follow and must leave the component safe. Not NULL.
    pub poll: Option<
        unsafe extern "C" fn(context: *mut c_void, now_ms: c_uint, report: *mut Report) -> c_int,
    >,
    /// Stops the task as soon as it is safe; a later `poll` returns ZTL_NODE_ABORTED. Not NULL.
    pub abort: Option<unsafe extern "C" fn(context: *mut c_void, now_ms: c_uint)>,
    /// Goes to the safe state, with or without a task, after a lost link or an emergency stop. If that takes time, `poll`
    /// continues it: the node calls `poll` until it returns ZTL_NODE_ABORTED or ZTL_NODE_COMPLETED, which ends a task. If it
    /// returns ZTL_NODE_FAILED, because a pin failed, the node calls `make_safe` again, every 50 ms. Not NULL.
    pub make_safe: Option<unsafe extern "C" fn(context: *mut c_void, now_ms: c_uint)>,
    /// Writes the next reading and the index of its topic, if one is due and fits. Returns the number of bytes, 0 for no
    /// reading. The node calls it at most every 10 ms. `size` is the longest reading that a frame holds: drop a longer one,
    /// because it can never be sent. NULL if it publishes nothing.
    pub reading: Option<
        unsafe extern "C" fn(
            context: *mut c_void,
            now_ms: c_uint,
            topic: *mut c_uchar,
            buffer: *mut c_uchar,
            size: usize,
        ) -> usize,
    >,
}

/// Points to the description that the firmware keeps. It was checked when the node was created.
#[derive(Clone, Copy)]
pub(crate) struct Part(*const Component);

impl Part {
    /// Checks a component and wraps it.
    ///
    /// # Safety
    /// `component` and its texts outlive the part and do not change.
    pub(crate) unsafe fn new(component: *const Component) -> Result<Self, c_int> {
        let part = Self(component);
        let it = part.get();
        // SAFETY: texts or NULL, as the caller promises.
        let texts = unsafe {
            is_text(it.name, false)
                && is_text(it.words, true)
                && is_text(it.unit, true)
                && is_text(it.topics, true)
        };
        let complete =
            it.start.is_some() && it.poll.is_some() && it.abort.is_some() && it.make_safe.is_some();
        let policies = (ZTL_NODE_REPLACE..=255).contains(&it.busy)
            && (ZTL_NODE_LOSS_ABORT..=ZTL_NODE_LOSS_CARRY_ON).contains(&it.loss);
        match (complete && !it.name.is_null(), texts, policies) {
            (false, ..) => Err(ZTL_NODE_E_NULL),
            (_, false, _) => Err(ZTL_NODE_E_TEXT),
            (.., false) => Err(ZTL_NODE_E_POLICY),
            _ => Ok(part),
        }
    }

    const fn get(&self) -> &Component {
        // SAFETY: it outlives this, by the condition of `new`, and never changes.
        unsafe { &*self.0 }
    }

    /// Passes the goal to C, terminated by a zero.
    fn with_goal(
        goal: &str,
        why: &mut ztl_mcu::Report<'_>,
        call: impl FnOnce(*const c_char, *mut Report) -> c_int,
    ) -> Result<(), Refused> {
        // Longer than any goal that fits a frame.
        let mut buffer = [0u8; ZTL_NODE_FRAME];
        let bytes = goal.as_bytes();
        if bytes.len() >= buffer.len() || bytes.contains(&0) {
            why.text("a goal must not contain a zero byte");
            return Err(Refused);
        }
        for (to, from) in buffer.iter_mut().zip(bytes) {
            *to = *from;
        }
        match call(buffer.as_ptr().cast(), Report::of(why)) {
            ZTL_NODE_TAKEN => Ok(()),
            _ => Err(Refused),
        }
    }
}

impl ztl_mcu::Component for Part {
    fn offer(&self) -> Offer<'_> {
        let it = self.get();
        // SAFETY: texts or NULL that outlive the component, by the condition of `new`.
        let told = |pointer| unsafe { text(pointer) }.unwrap_or_default();
        let goal = GoalShape {
            // Equal bounds mean no range. Compares bits, which takes no float arithmetic.
            range: (it.least.to_bits() != it.most.to_bits()).then_some((it.least, it.most)),
            unit: told(it.unit),
            words: told(it.words),
        };
        Offer {
            name: told(it.name),
            goal,
            busy: match it.busy {
                ZTL_NODE_REFUSE => Busy::Refuse,
                ZTL_NODE_REPLACE => Busy::Replace,
                count => Busy::Queue(u8::try_from(count).unwrap_or(u8::MAX)),
            },
            loss: match it.loss {
                ZTL_NODE_LOSS_HOLD => Loss::Hold,
                ZTL_NODE_LOSS_CARRY_ON => Loss::CarryOn,
                _ => Loss::Abort,
            },
            topics: told(it.topics),
        }
    }

    fn check(&self, goal: &str, why: &mut ztl_mcu::Report<'_>) -> Result<(), Refused> {
        let Some(check) = self.get().check else {
            return Ok(());
        };
        Self::with_goal(goal, why, |goal, why| {
            // SAFETY: the firmware's function, called as the header specifies; goal and report outlive the
            // call.
            unsafe { check(self.get().context, goal, why) }
        })
    }

    fn start(
        &mut self,
        now: Instant,
        goal: &str,
        why: &mut ztl_mcu::Report<'_>,
    ) -> Result<(), Refused> {
        let Some(start) = self.get().start else {
            return Err(Refused);
        };
        Self::with_goal(goal, why, |goal, why| {
            // SAFETY: as in `check`.
            unsafe { start(self.get().context, millis(now), goal, why) }
        })
    }

    fn poll(&mut self, now: Instant, report: &mut ztl_mcu::Report<'_>) -> Run {
        let Some(poll) = self.get().poll else {
            return Run::Failed;
        };
        // SAFETY: the firmware's function, called as the header specifies; the report outlives the call.
        let state = unsafe { poll(self.get().context, millis(now), Report::of(report)) };
        match state {
            ZTL_NODE_COMPLETED => Run::Completed,
            ZTL_NODE_FAILED => Run::Failed,
            ZTL_NODE_ABORTED => Run::Aborted,
            _ => Run::Running,
        }
    }

    fn abort(&mut self, now: Instant) {
        if let Some(abort) = self.get().abort {
            // SAFETY: the firmware's function, called as the header specifies.
            unsafe { abort(self.get().context, millis(now)) };
        }
    }

    fn make_safe(&mut self, now: Instant) {
        if let Some(make_safe) = self.get().make_safe {
            // SAFETY: the firmware's function, called as the header specifies.
            unsafe { make_safe(self.get().context, millis(now)) };
        }
    }

    fn poll_timeout(&self, now: Instant) -> Instant {
        let every = match self.get().poll_ms {
            0 => 10,
            every => u64::from(every),
        };
        now + Duration::from_millis(every)
    }

    fn poll_reading(&mut self, now: Instant, buffer: &mut [u8]) -> Option<Reading> {
        let reading = self.get().reading?;
        let (mut topic, size) = (0, buffer.len());
        // SAFETY: the firmware's function, called as the header specifies: it writes a topic and at most
        // `size` bytes of the buffer.
        let len = unsafe {
            reading(
                self.get().context,
                millis(now),
                &raw mut topic,
                buffer.as_mut_ptr(),
                size,
            )
        };
        (len > 0 && len <= size).then_some(Reading { topic, len })
    }
}
