//! The gateway: microcontrollers as handlers of a task server.
//!
//! Each device has a [session](ztl_link::Session) on its own thread, so a slow or dead device does not affect
//! others. A client's `gripper:finger:40` goes to the device named `gripper`.

mod bus;
pub mod config;
mod description;
mod device;
mod devices;
mod endpoint;
#[cfg(feature = "defmt")]
mod firmware_log;
mod handler;
mod journal;
mod logs;
mod opener;
mod parameters;
mod rate_limited_log;
mod reading_value;
mod readings;
mod report;
mod ring;
mod seat;
mod updates;

pub use devices::{AddError, Devices};
pub use endpoint::{
    BAUD, Endpoint, EndpointError, InProcess, Line, ParseEndpoint, READ_TIMEOUT, is_pause,
};
pub use handler::Gateway;
pub use journal::{DeviceJournal, Journal, JournalError, JournalRecords, Moment, Storage};
pub use logs::{LogPiece, RawLog};
pub use parameters::{PARAMETERS, ParameterGoal, ParameterReport, ReportedValue};
pub use reading_value::{READING_FORMATS, ReadingFormat};
pub use readings::{Reading, Readings};
pub use report::{ComponentReport, DeviceReport, DeviceReports, FirmwareReport, LinkReport};
pub use updates::{
    LONGEST_IMAGE, LONGEST_PART, RunningFirmware, UPDATES, UpdateGoal, UpdateOptions,
    UpdateProblem, Updated,
};
