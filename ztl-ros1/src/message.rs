//! Messages of ROS 1 by their definitions, which are read at run time.
//!
//! | file | what |
//! |---|---|
//! | `definition` | parses the text of a definition |
//! | `definitions` | finds definitions, and resolves the types of their fields |
//! | `packages` | where the robot's ROS keeps its packages |
//! | `carried` | definitions for robots whose files are lacking |
//! | `message_type` | a resolved type: fields, md5 sum, full text |
//! | `value` | the value of a message |
//! | `decode`, `encode` | values from bytes, and bytes from values |
//!
//! ```
//! use ztl_ros1::message::{Definitions, Value};
//!
//! let mut definitions = Definitions::carried();
//! let twist = definitions.message("geometry_msgs/Twist").unwrap();
//! assert_eq!(twist.md5(), "9f195f881246fdfa2798d1d3eebca84a");
//! let still = twist.zero();
//! let bytes = twist.encode(&still).unwrap();
//! assert_eq!(bytes, [0; 48]);
//! assert_eq!(twist.decode(&bytes).unwrap(), still);
//! assert_eq!(still.at("linear.x"), Some(&Value::Float(0.0)));
//! ```

mod carried;
mod decode;
mod definition;
mod definitions;
mod encode;
mod message_type;
mod packages;
mod value;

pub use decode::{DecodeError, DecodeErrorKind};
pub use definition::{Constant, Primitive};
pub use definitions::{DefinitionError, Definitions};
pub use encode::EncodeError;
pub use message_type::{ActionType, Count, Element, Field, FieldType, MessageType, ServiceType};
pub use value::Value;

#[cfg(test)]
mod tests;
