//! A node of ROS 1 without ROS: topics, services, parameters and actions of robots.
//!
//! The wire rules are parsers and state machines without I/O. One thread for each node moves the bytes.

mod action;
#[cfg(test)]
mod damage;
mod graph;
mod http;
mod live_type;
pub mod message;
mod node;
mod survey;
mod tcpros;
mod uri;
pub mod xmlrpc;

pub use action::{EndState, GoalEnd, GoalEvent};
pub use node::{
    ActionClient, Audience, CallError, Config, Goal, Listener, Loss, NetError, Node, OpenError,
    Pace, Publisher, ServiceError, StartError, Subscription, TypeConflict,
};
pub use survey::Survey;

/// A type of messages, as the wire needs it: bodies are bytes.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct WireType {
    /// Such as `std_msgs/String`; `*` for any.
    pub name: String,
    /// The MD5 sum of the definition, 32 hexadecimal digits; `*` for any.
    pub md5: String,
    /// The text of the definition with those that it uses. Only tools such as `rosbag` read it.
    pub definition: String,
}

/// The types of an action's messages.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionTypes {
    /// Such as `control_msgs/FollowJointTrajectoryActionGoal`.
    pub goal: WireType,
    /// Such as `control_msgs/FollowJointTrajectoryActionFeedback`.
    pub feedback: WireType,
    /// Such as `control_msgs/FollowJointTrajectoryActionResult`.
    pub result: WireType,
}
