//! Why connections fail.

use std::{fmt, io};

/// Why a connection is closed, or was never open.
#[derive(Debug, Clone, PartialEq, Eq)]
#[non_exhaustive]
pub enum NetError {
    /// This machine cannot resolve the name of the host.
    UnknownHost {
        /// The name.
        host: String,
    },
    /// The other end has closed it.
    Closed {
        /// The other end.
        peer: String,
    },
    /// Nothing listens at this address.
    Refused {
        /// The address.
        peer: String,
    },
    /// It could not be made, or the system has closed it.
    Failed {
        /// The other end.
        peer: String,
        /// The error of the system.
        error: String,
    },
    /// A connection that the other end has opened was reset, and the system has discarded what waited.
    Broken {
        /// The other end.
        peer: String,
        /// The error of the system.
        error: String,
    },
    /// It has acknowledged nothing for too long: the network is cut, or the node hangs.
    Silent {
        /// The other end.
        peer: String,
    },
    /// This node has closed it, because it has acknowledged nothing since the network was cut, and can be reached again.
    Stale {
        /// The other end.
        peer: String,
    },
    /// This node has closed it, because it has too many.
    Crowded {
        /// The other end.
        peer: String,
    },
    /// There was no answer in time.
    TimedOut {
        /// The other end.
        peer: String,
    },
}

impl fmt::Display for NetError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::UnknownHost { host } => write!(
                f,
                "this machine cannot resolve the host name '{host}': start the node there with ROS_HOSTNAME or \
                 ROS_IP set to what others can reach, or add the name to /etc/hosts here"
            ),
            Self::Closed { peer } => write!(f, "{peer} has closed the connection"),
            Self::Refused { peer } => write!(f, "no connection to {peer}: connection refused"),
            Self::Failed { peer, error } => write!(f, "no connection to {peer}: {error}"),
            Self::Broken { peer, error } => write!(f, "the connection of {peer} failed: {error}"),
            Self::Silent { peer } => {
                write!(f, "{peer} has not acknowledged in time what was sent to it")
            }
            Self::Stale { peer } => write!(
                f,
                "{peer} can be reached again, but has not acknowledged what was sent during a cut; that is sent again when it \
                 has connected again"
            ),
            Self::Crowded { peer } => {
                write!(
                    f,
                    "this node has closed the connection of {peer}, because others hold too many open"
                )
            }
            Self::TimedOut { peer } => write!(f, "no answer from {peer} in time"),
        }
    }
}

impl std::error::Error for NetError {}

/// The text of an error without its number.
pub(crate) fn plain(error: &io::Error) -> String {
    let text = error.to_string();
    let end = text.find(" (os error").unwrap_or(text.len());
    text.get(..end).unwrap_or_default().to_lowercase()
}
