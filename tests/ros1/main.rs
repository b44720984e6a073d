//! Robots of ROS 1: a real master, rospy and actionlib against our node.

mod actions;
mod audience;
mod check;
mod hostile;
mod late;
mod log;
mod master;
mod names;
mod rig;
mod robots;
mod serve;
mod topics;
