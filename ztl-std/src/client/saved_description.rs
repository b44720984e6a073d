//! What a server said of itself, from a file that `ztl describe --json` has written.

use std::collections::BTreeMap;
use std::path::Path;

use serde_json::Value;
use ztl_yaml::{Diagnostic, Diagnostics};

use super::components::{DescribedComponent, of_scope};
use super::description::Description;
use crate::describe::ScopeDescriptions;
use crate::files::read_yaml;
use crate::offers::Offers;

/// What a server said of itself, as `ztl describe --json` wrote it.
#[derive(Debug, Clone)]
#[non_exhaustive]
pub struct SavedDescription {
    /// Where the server was; empty if the file does not say it.
    pub endpoint: String,
    /// What each scope offers.
    pub scopes: BTreeMap<String, Offers>,
    /// What its components say of themselves.
    pub components: Vec<DescribedComponent>,
}

impl SavedDescription {
    /// Reads a file. Skips components that cannot be read.
    ///
    /// # Errors
    /// Why the file cannot be read, or that it is not a description.
    pub fn load(path: &Path) -> Result<Self, Diagnostics> {
        let bytes = read_yaml(path)?;
        Self::read(&bytes).map_err(|why| {
            let message = format!("this is not the description of a server: {why}");
            let found = Diagnostic::of_file(&path.display().to_string(), message);
            found
                .with_help("write one with `ztl describe --json -r HOST -p PORT > FILE`")
                .into()
        })
    }

    /// What the components of a scope say of themselves.
    #[must_use]
    pub fn scope(&self, scope: &str) -> ScopeDescriptions {
        of_scope(self.components.clone(), scope)
    }

    fn read(bytes: &[u8]) -> Result<Self, String> {
        let text = str::from_utf8(bytes).map_err(|error| error.to_string())?;
        let value: Value = serde_json::from_str(text).map_err(|error| error.to_string())?;
        let components = value.get("components").and_then(Value::as_array);
        let components = components.ok_or("it has no list 'components'")?;
        let told = Description::parse(text).ok_or("it has no 'version' and 'boot'")?;
        let endpoint = value.get("endpoint").and_then(Value::as_str);
        Ok(Self {
            endpoint: endpoint.unwrap_or_default().to_owned(),
            scopes: told.scopes,
            components: components
                .iter()
                .filter_map(DescribedComponent::read)
                .collect(),
        })
    }
}
