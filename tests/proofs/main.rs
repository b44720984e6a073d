//! What must hold whatever is lost, killed or stopped: no task runs twice, and no end is invented.

mod killed_processes;
mod lost_answers;
mod unknown_outcomes;
