//! What the journal keeps of an update, and how the next gateway goes on with it.

use ztl_core::Instant;
use ztl_link::FirmwareInfo;

use super::{Image, Step, UpdateJob, test_failed};
use crate::gateway::updates::{Note, UpdateOptions};

impl UpdateJob {
    /// An update whose gateway has ended after it had restarted the device.
    pub(in crate::gateway::device::worker) fn resume(
        now: Instant,
        note: &Note,
        tested: Option<Result<(), String>>,
    ) -> Self {
        let image = Image {
            version: note.image.clone(),
            manifest: Vec::new(),
            bytes: Vec::new(),
        };
        let options = UpdateOptions::default();
        let before = FirmwareInfo {
            board: String::new(),
            version: note.before.clone(),
            confirmed: true,
            self_test: None,
        };
        let failed = tested.as_ref().and_then(|result| result.as_ref().err());
        Self {
            step: Step::Lost,
            before: Some((note.boot, before)),
            // It may be about to restart.
            verifies: true,
            restarted: true,
            confirmed: note.trial.is_some(),
            unfit: failed.map(|reason| test_failed(reason)),
            aborted: note.aborted,
            trial: note.trial.clone(),
            tested,
            resumed: true,
            ..Self::new(now, image, options)
        }
    }

    /// What the next gateway must know to go on, from the restart of the device on.
    pub(in crate::gateway::device::worker) fn note(&self) -> Option<Note> {
        let (boot, before) = self.before.as_ref().filter(|_| self.restarted)?;
        Some(Note {
            boot: *boot,
            before: before.version.clone(),
            image: self.image.version.clone(),
            test: None,
            stopped: false,
            trial: self.trial.clone().filter(|_| self.confirmed),
            aborted: self.aborted,
            board: None,
        })
    }
}
