//! A message's type with the types of its fields.

use std::fmt;
use std::fmt::Write as _;
use std::sync::Arc;

use md5::{Digest, Md5};

use super::definition::{Constant, Definition, Primitive};

/// The most values that a message has in memory. A byte array counts a sixteenth of its length. A value takes
/// about 50 bytes, and a list that grows twice as much.
pub(super) const MOST_VALUES: usize = 1 << 19;

/// A message's type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct MessageType {
    name: String,
    fields: Vec<Field>,
    constants: Vec<Constant>,
    md5: String,
    md5_text: String,
    /// Of its own definition.
    text: String,
    /// The fewest bytes of a message.
    least_size: usize,
    /// How many values a message has at least in memory.
    least_values: usize,
}

/// A field of a message.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Field {
    /// Its name.
    pub name: Arc<str>,
    /// Its type.
    pub field_type: FieldType,
}

/// The type of a field.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct FieldType {
    /// Of what.
    pub element: Element,
    /// How many.
    pub count: Count,
}

/// The type of a value, or of each value of an array.
#[derive(Debug, Clone, PartialEq, Eq)]
pub enum Element {
    /// A type that ROS defines.
    Primitive(Primitive),
    /// A message within a message.
    Message(Arc<MessageType>),
}

/// How many values a field has.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Count {
    /// A single value.
    One,
    /// An array of this length.
    Fixed(usize),
    /// An array of any length.
    Any,
}

/// A service's type.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ServiceType {
    /// As `std_srvs/Trigger`.
    pub name: String,
    /// What a client sends.
    pub request: Arc<MessageType>,
    /// What it gets.
    pub response: Arc<MessageType>,
    /// The md5 sum of both.
    pub md5: String,
}

/// An action's type: those of its topics, and those of the parts that people write and read.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ActionType {
    /// As `move_base_msgs/MoveBaseAction`.
    pub name: String,
    /// Of the topic `goal`, with header and goal id.
    pub action_goal: Arc<MessageType>,
    /// Of the topic `result`, with header and status.
    pub action_result: Arc<MessageType>,
    /// Of the topic `feedback`, with header and status.
    pub action_feedback: Arc<MessageType>,
    /// The field `goal` of an action goal.
    pub goal: Arc<MessageType>,
    /// The field `result` of an action result.
    pub result: Arc<MessageType>,
    /// The field `feedback` of action feedback.
    pub feedback: Arc<MessageType>,
}

impl MessageType {
    /// A type of this definition and these fields, which are in the definition's order.
    ///
    /// # Errors
    /// If a message has too many values, at least.
    pub(super) fn new(
        name: &str,
        text: &str,
        definition: Definition,
        types: Vec<FieldType>,
    ) -> Result<Self, String> {
        let mut md5_text = String::new();
        for constant in &definition.constants {
            let Constant {
                name,
                type_name,
                text,
            } = constant;
            // Writing to a text does not fail.
            let _ = writeln!(md5_text, "{type_name} {name}={text}");
        }
        let mut fields = Vec::new();
        let (mut least_size, mut least_values) = (0_usize, 1_usize);
        for (declared, field_type) in definition.fields.into_iter().zip(types) {
            let shown = match &field_type.element {
                Element::Primitive(_) => declared.written.as_str(),
                // Without brackets, also for an array.
                Element::Message(message) => &message.md5,
            };
            let _ = writeln!(md5_text, "{shown} {}", declared.name);
            least_size = least_size.saturating_add(field_type.least_size());
            least_values = least_values.saturating_add(field_type.least_values());
            if least_values > MOST_VALUES {
                let (field, most) = (&declared.name, MOST_VALUES);
                return Err(format!(
                    "{field}: the message has more than {most} values, which this program does not take"
                ));
            }
            fields.push(Field {
                name: declared.name.into(),
                field_type,
            });
        }
        md5_text.truncate(md5_text.trim_end().len());
        Ok(Self {
            name: name.to_owned(),
            fields,
            constants: definition.constants,
            md5: md5_of(&[&md5_text]),
            md5_text,
            text: text.to_owned(),
            least_size,
            least_values,
        })
    }

    /// Its name, as `geometry_msgs/Twist`.
    #[must_use]
    pub fn name(&self) -> &str {
        &self.name
    }

    /// The fields in order.
    #[must_use]
    pub fn fields(&self) -> &[Field] {
        &self.fields
    }

    /// The constants in order.
    #[must_use]
    pub fn constants(&self) -> &[Constant] {
        &self.constants
    }

    /// The field of this name.
    #[must_use]
    pub fn field(&self, name: &str) -> Option<&FieldType> {
        let found = self.fields.iter().find(|field| *field.name == *name);
        found.map(|field| &field.field_type)
    }

    /// The md5 sum in hexadecimal digits, as genmsg computes it.
    #[must_use]
    pub fn md5(&self) -> &str {
        &self.md5
    }

    /// The text of the definition and of all that it uses, as `message_definition` in the header of a connection.
    #[must_use]
    pub fn full_text(&self) -> String {
        let mut used: Vec<&MessageType> = Vec::new();
        self.add_used(&mut used);
        let mut full = format!("{}\n", self.text);
        for message in used {
            let rule = "=".repeat(80);
            let _ = write!(full, "{rule}\nMSG: {}\n{}\n", message.name, message.text);
        }
        // genmsg leaves out the last line break.
        full.pop();
        full
    }

    /// Adds the types that this one uses, each once, before those that it uses.
    fn add_used<'t>(&'t self, used: &mut Vec<&'t Self>) {
        for field in &self.fields {
            if let Element::Message(message) = &field.field_type.element
                && used.iter().all(|known| known.name != message.name)
            {
                used.push(message);
                message.add_used(used);
            }
        }
    }

    pub(super) const fn least_size(&self) -> usize {
        self.least_size
    }
}

impl ServiceType {
    pub(super) fn new(name: &str, request: Arc<MessageType>, response: Arc<MessageType>) -> Self {
        Self {
            name: name.to_owned(),
            md5: md5_of(&[&request.md5_text, &response.md5_text]),
            request,
            response,
        }
    }
}

impl FieldType {
    /// Whether its values are kept as bytes.
    #[must_use]
    pub fn is_bytes(&self) -> bool {
        self.count != Count::One && self.element == Element::Primitive(Primitive::Uint8)
    }

    fn least_size(&self) -> usize {
        match self.count {
            Count::One => self.element.least_size(),
            Count::Fixed(length) => self.element.least_size().saturating_mul(length),
            Count::Any => 4,
        }
    }

    fn least_values(&self) -> usize {
        let of_elements = match (&self.element, self.count) {
            (_, Count::Any) => 0,
            (_, Count::Fixed(length)) if self.is_bytes() => length / 16,
            (Element::Primitive(_), Count::One) => 0,
            (Element::Primitive(_), Count::Fixed(length)) => length,
            (Element::Message(message), Count::One) => message.least_values,
            (Element::Message(message), Count::Fixed(length)) => {
                message.least_values.saturating_mul(length)
            }
        };
        of_elements.saturating_add(1)
    }
}

impl Element {
    pub(super) fn least_size(&self) -> usize {
        match self {
            Self::Primitive(primitive) => primitive.least_size(),
            Self::Message(message) => message.least_size(),
        }
    }
}

impl fmt::Display for Element {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Primitive(primitive) => primitive.name(),
            Self::Message(message) => message.name(),
        })
    }
}

impl fmt::Display for FieldType {
    /// As a definition has it, as `float64[3]`.
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.count {
            Count::One => write!(f, "{}", self.element),
            Count::Fixed(length) => write!(f, "{}[{length}]", self.element),
            Count::Any => write!(f, "{}[]", self.element),
        }
    }
}

fn md5_of(texts: &[&str]) -> String {
    let mut md5 = Md5::new();
    for text in texts {
        md5.update(text.as_bytes());
    }
    let mut digits = String::new();
    for byte in md5.finalize() {
        let _ = write!(digits, "{byte:02x}");
    }
    digits
}
