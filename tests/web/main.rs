//! `ztl web` with real clients: Chromium at three sizes, roslib, roslibpy, and requests of strangers.

mod clients;
mod console;
mod gate;
mod page;
mod socket;
