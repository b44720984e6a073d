//! A gateway that is killed, by SIGKILL and at any moment, and started again on its journal: each
//! task that was asked for has one id and one end, and the end that is told is the true one.

mod device;
mod disk;
mod handler;
mod kills;
mod lab;
mod power;
mod returns;
mod stopped;
