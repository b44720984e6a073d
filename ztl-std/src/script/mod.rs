//! Scripts: scenes of steps of tasks, as people write them who do not program.

pub mod event;
pub mod record;
