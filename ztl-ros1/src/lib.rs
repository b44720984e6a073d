//! A node of ROS 1 without ROS: topics, services, parameters and actions of robots.

pub mod message;
