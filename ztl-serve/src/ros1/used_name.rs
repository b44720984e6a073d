//! The names in ROS that a file uses, for `--check`.

use ztl_ros1::WireType;
use ztl_ros1::message::{ActionType, MessageType, ServiceType};
use ztl_yaml::Diagnostic;

/// A name in ROS that the file uses.
#[derive(Debug, Clone)]
pub(crate) struct UsedName {
    /// Where the file has it; its message is still to be written.
    pub(super) place: Diagnostic,
    pub(super) name: String,
    pub(super) of: UsedType,
}

/// The type of a used name.
#[derive(Debug, Clone)]
pub(crate) struct UsedType {
    pub(super) kind: NameKind,
    /// As the file has it.
    pub(super) ty: String,
    /// The definitions that this machine has for what is received or called.
    pub(super) known: Vec<Known>,
    /// That for what is published.
    pub(super) published: Option<Known>,
    /// The node that must receive it.
    pub(super) subscriber: Option<String>,
}

/// What a name is of.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum NameKind {
    Action,
    /// A topic that tasks publish.
    Published,
    /// A topic that is received.
    Received,
    Service,
    Parameter,
}

impl NameKind {
    pub(super) const fn what(self) -> &'static str {
        match self {
            Self::Action => "action",
            Self::Published | Self::Received => "topic",
            Self::Service => "service",
            Self::Parameter => "parameter",
        }
    }
}

/// A definition that this machine has for a topic or service.
#[derive(Debug, Clone)]
pub(super) struct Known {
    /// What follows the used name.
    pub(super) suffix: &'static str,
    pub(super) ty: String,
    pub(super) md5: String,
}

impl Known {
    fn of(suffix: &'static str, message: &MessageType) -> Self {
        Self {
            suffix,
            ty: message.name().to_owned(),
            md5: message.md5().to_owned(),
        }
    }

    /// As the wire needs it.
    pub(super) fn wire(&self) -> WireType {
        WireType {
            name: self.ty.clone(),
            md5: self.md5.clone(),
            definition: String::new(),
        }
    }
}

impl UsedType {
    fn new(kind: NameKind, ty: &str) -> Self {
        Self {
            kind,
            ty: ty.to_owned(),
            known: Vec::new(),
            published: None,
            subscriber: None,
        }
    }

    pub(crate) fn action(ty: &ActionType) -> Self {
        Self {
            known: vec![
                Known::of("/result", &ty.action_result),
                Known::of("/feedback", &ty.action_feedback),
            ],
            published: Some(Known::of("/goal", &ty.action_goal)),
            ..Self::new(NameKind::Action, &ty.name)
        }
    }

    /// A topic that tasks publish. `subscriber`: the node that must receive it.
    pub(crate) fn published(ty: &MessageType, subscriber: Option<String>) -> Self {
        Self {
            published: Some(Known::of("", ty)),
            subscriber,
            ..Self::new(NameKind::Published, ty.name())
        }
    }

    pub(crate) fn received(ty: &MessageType) -> Self {
        Self {
            known: vec![Known::of("", ty)],
            ..Self::new(NameKind::Received, ty.name())
        }
    }

    pub(crate) fn service(ty: &ServiceType) -> Self {
        let known = Known {
            suffix: "",
            ty: ty.name.clone(),
            md5: ty.md5.clone(),
        };
        Self {
            known: vec![known],
            ..Self::new(NameKind::Service, &ty.name)
        }
    }

    pub(crate) fn parameter() -> Self {
        Self::new(NameKind::Parameter, "")
    }
}

impl UsedName {
    pub(super) fn warning(&self, message: String, help: Option<String>) -> Diagnostic {
        let mut warning = self.place.clone();
        warning.message = format!("warning: {message}");
        warning.help = help;
        warning
    }
}
