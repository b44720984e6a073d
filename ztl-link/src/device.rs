//! Descriptions of devices and their components.

use std::time::Duration;

use ztl_core::link::update::PIECE_UNIT;
use ztl_core::link::{Busy, Loss};

use crate::parameters::ParameterInfo;

/// Longest piece for a node on a shared line: 16 nodes with tasks have their turn every 50 ms also while one is updated.
const SHARED_PIECE: usize = 2 * PIECE_UNIT;

/// A component, as its device describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct ComponentInfo {
    /// Name, as clients write it.
    pub name: String,
    /// Smallest and largest number that it accepts.
    pub range: Option<(f32, f32)>,
    /// Unit of the numbers.
    pub unit: String,
    /// Words that it accepts.
    pub words: Vec<String>,
    /// What happens to a second task while one runs.
    pub busy: Busy,
    /// What it does when the link is lost.
    pub loss: Loss,
    /// Topics of its readings.
    pub topics: Vec<String>,
    /// What it says of itself so far, in JSON (`docs/protocol.md` [11.7]); empty if it says nothing.
    pub description: Vec<u8>,
}

/// A device, as it describes itself.
#[derive(Debug, Clone, PartialEq)]
pub struct DeviceInfo {
    /// Its name in the firmware.
    pub name: String,
    /// Version of its firmware.
    pub firmware: String,
    /// Number that changes with each reset.
    pub boot: u32,
    /// Longest body that it accepts, in bytes.
    pub max_body: usize,
    /// After how long without a new command it considers the link lost.
    pub link_timeout: Duration,
    /// Number of components.
    pub count: u8,
    /// The components described so far.
    pub components: Vec<ComponentInfo>,
    /// Number of its parameters; 0 until it has announced them (`docs/link.md` [13.1]).
    pub parameters: u8,
    /// The parameters read so far, as they were read last: from the first on, without gaps.
    pub known_parameters: Vec<ParameterInfo>,
    /// Whether other nodes share its line.
    pub shared: bool,
    /// Whether it takes firmware updates; `false` until it has announced them (`docs/link.md` [16.1]).
    pub updates: bool,
}

impl DeviceInfo {
    /// Most bytes of an image in one message; 0 if the device takes none.
    #[must_use]
    pub const fn longest_piece(&self) -> usize {
        // Tag, offset and length take at most 8 bytes.
        let room = self.max_body.saturating_sub(8);
        let whole = room - room % PIECE_UNIT;
        // A longer one would delay the turns of other nodes.
        if self.shared && whole > SHARED_PIECE {
            SHARED_PIECE
        } else {
            whole
        }
    }

    pub(crate) fn note_parameter(&mut self, index: usize, info: &ParameterInfo) {
        let next = self.known_parameters.len();
        match self.known_parameters.get_mut(index) {
            Some(known) => known.clone_from(info),
            None if index == next => self.known_parameters.push(info.clone()),
            None => {}
        }
    }

    /// The component and the name of a topic. Topics are numbered in the order of their components.
    #[must_use]
    pub fn topic(&self, number: u8) -> Option<(&str, &str)> {
        let mut topics = self.components.iter().flat_map(|component| {
            let topics = component.topics.iter();
            topics.map(|topic| (component.name.as_str(), topic.as_str()))
        });
        topics.nth(usize::from(number))
    }
}
