//! Devices on real lines with lost, damaged or delayed data, and firmware on boards in QEMU.

mod boards;
mod line_command;
mod line_faults;
mod link;
mod link_examples;
mod link_parameters;
mod link_updates;
mod updates;
