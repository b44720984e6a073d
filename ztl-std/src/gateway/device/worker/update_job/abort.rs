//! An update that a client aborts.

use ztl_core::Instant;
use ztl_link::UpdateRequest;

use super::{Next, Outcome, Step, UpdateJob};

/// Why a device goes back whose update was aborted.
pub(super) const ABORTED: &str = "the update was aborted";

impl UpdateJob {
    /// A client aborts it. The firmware before stays, or the device goes back to it. It ends when the device has said so: one
    /// that verifies may mark the image to run meanwhile.
    pub(in crate::gateway::device::worker) fn abort(&mut self, now: Instant) -> Next {
        self.aborted = true;
        match self.step {
            Step::Test => self.revert(now, ABORTED.to_owned()),
            _ if self.restarted => Next::Wait,
            _ if !self.verifies => self.end_aborted(),
            Step::Verify => {
                self.again = None;
                Next::Ask(UpdateRequest::Cancel)
            }
            _ => Next::Wait,
        }
    }

    /// The device has no image that a reset would run.
    pub(super) fn end_aborted(&mut self) -> Next {
        self.restarted = false;
        Next::End(Outcome::Aborted(format!(
            "aborted; the device keeps {}",
            self.version_before()
        )))
    }

    /// The device does not take the mark away: a client has started a task.
    pub(super) fn end_marked(&mut self) -> Next {
        self.restarted = false;
        Next::End(Outcome::Aborted(format!(
            "aborted; the device runs {}, and may run {} after its next reset: a task keeps it from dropping the image",
            self.version_before(),
            self.image.version
        )))
    }

    /// Whether a reset may run the image, although the device was not restarted for it.
    pub(in crate::gateway::device::worker) const fn may_be_marked(&self) -> bool {
        self.verifies && !self.restarted
    }
}
