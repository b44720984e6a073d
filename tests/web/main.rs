//! `ztl web` with real clients: Chromium at three sizes, roslib, roslibpy, and requests of strangers.

mod client;
mod clients;
mod console;
mod devices;
mod figures;
mod gate;
mod goals;
mod page;
mod record;
mod robot;
mod show;
mod socket;
mod stops;
mod streams;
