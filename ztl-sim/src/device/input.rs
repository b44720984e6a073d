//! What happens to a simulated device, or to a shared line of several.

use std::io::Write;
use std::sync::mpsc::Sender;

/// What happens to a running device.
pub(super) enum Input {
    Bytes(Vec<u8>),
    /// Where the node's output goes from now on.
    Line(Option<Box<dyn Write + Send>>),
    /// A button is pushed; where the answer goes.
    Push(Push, Sender<Result<(), String>>),
    /// For a simulated line.
    OnLine(OnLine),
    Reset,
    Stop,
}

/// What a person does at the device.
#[derive(Debug)]
pub(super) enum Push {
    /// Starts a task with this goal.
    Press(String),
    /// Aborts it.
    Release,
    /// Reports an event.
    Report(String),
}

/// What happens on a simulated line.
pub(super) enum OnLine {
    /// The node with this number transmits.
    Spoken(usize, Vec<u8>),
    /// Switches a node on or off; where the answer goes.
    Power(String, bool, Sender<Result<(), String>>),
    /// Asks where a node's input goes; where the answer goes.
    Find(String, Sender<Option<Sender<Input>>>),
}
