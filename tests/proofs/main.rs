//! What holds when messages are lost and processes are killed or stopped: no task runs twice, and no outcome is invented.

mod killed_processes;
mod lost_answers;
mod task_lists;
mod unknown_outcomes;
