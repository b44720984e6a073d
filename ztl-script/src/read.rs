//! From a YAML document to scenes, by PyYAML's rules (`docs/compatibility.md`, "YAML"), with everything wrong or
//! doubtful in it.

mod keys;
mod params;
mod reader;
mod scenes;
mod values;

pub(crate) use scenes::scenes;
pub use values::read_value;
