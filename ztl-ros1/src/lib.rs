//! A node of ROS 1 without ROS: topics, services, parameters and actions of robots.
//!
//! The wire rules are parsers and state machines without I/O. One thread for each node moves the bytes.

mod http;
mod tcpros;
mod uri;
pub mod xmlrpc;
