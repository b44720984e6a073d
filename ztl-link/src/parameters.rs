//! Parameters of a device, and requests about them.

use ztl_core::link::parameter::{Domain, Kept, NO_COMPONENT, Parameter, Value};

/// A value of a parameter.
#[derive(Debug, Clone, PartialEq)]
pub enum ParameterValue {
    /// A switch.
    Bool(bool),
    /// A number without sign.
    U32(u32),
    /// A whole number.
    I32(i32),
    /// A number.
    F32(f32),
    /// A text.
    Text(String),
}

impl ParameterValue {
    /// The value to send or to check.
    #[must_use]
    pub fn as_value(&self) -> Value<'_> {
        match self {
            Self::Bool(on) => Value::Bool(*on),
            Self::U32(number) => Value::U32(*number),
            Self::I32(number) => Value::I32(*number),
            Self::F32(number) => Value::F32(*number),
            Self::Text(text) => Value::Text(text),
        }
    }
}

impl From<Value<'_>> for ParameterValue {
    fn from(value: Value<'_>) -> Self {
        match value {
            Value::Bool(on) => Self::Bool(on),
            Value::U32(number) => Self::U32(number),
            Value::I32(number) => Self::I32(number),
            Value::F32(number) => Self::F32(number),
            Value::Text(text) => Self::Text(text.to_owned()),
        }
    }
}

/// A parameter, as its device describes it.
#[derive(Debug, Clone, PartialEq)]
pub struct ParameterInfo {
    /// Index of its component; `None` if it belongs to the firmware as a whole.
    pub component: Option<usize>,
    /// Its name.
    pub name: String,
    /// Unit of the numbers.
    pub unit: String,
    /// What it means.
    pub about: String,
    /// What happens to its value when the device restarts.
    pub kept: Kept,
    /// The values that it takes.
    pub domain: Domain,
    /// Its value until it is set.
    pub default: ParameterValue,
    /// Its value.
    pub value: ParameterValue,
}

impl From<Parameter<'_>> for ParameterInfo {
    fn from(parameter: Parameter<'_>) -> Self {
        let component = parameter.component;
        Self {
            component: (component != NO_COMPONENT).then_some(component.into()),
            name: parameter.name.to_owned(),
            unit: parameter.unit.to_owned(),
            about: parameter.about.to_owned(),
            kept: parameter.kept,
            domain: parameter.domain,
            default: parameter.default.into(),
            value: parameter.value.into(),
        }
    }
}

/// What to do with the parameters of a device.
#[derive(Debug, Clone, PartialEq)]
pub enum ParameterRequest {
    /// Read the one with this index.
    Read(u8),
    /// Set the one with this index.
    Set(u8, ParameterValue),
    /// Save all values.
    Save,
}

/// Why a request about parameters has failed.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum ParameterFailure {
    /// The device has no parameters, or its firmware is older than parameters.
    NoParameters,
    /// It was not sent, for this reason.
    NotSent(&'static str),
    /// The device refuses it, for this reason.
    Refused(String),
    /// The link was lost before the answer: it is unknown whether the device has carried out the request.
    Unknown,
}

/// The answer to a request: the parameter, or `None` when all are saved.
pub type ParameterAnswer = Result<Option<ParameterInfo>, ParameterFailure>;
