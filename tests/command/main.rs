//! The command `ztl`: its options, output, errors and exit codes, and the static build.

mod boot;
mod completions;
mod dist;
mod doctor;
mod errors;
mod examples;
mod exit_codes;
mod firmware;
mod foxglove;
mod frozen_server;
mod lost_output;
mod options;
mod output;
mod recording;
mod streams;
mod watching;
