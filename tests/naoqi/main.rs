//! The client of NAOqi, against libqi itself: services with the names and signatures of NAO.

mod calls;
mod cancelled;
mod lost;
mod many;
mod robot;
mod serve;
mod signals;
