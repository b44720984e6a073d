//! Devices on real lines: what is lost, damaged or late on the way, and firmware on boards in QEMU.

mod boards;
mod line_command;
mod line_faults;
mod link;
