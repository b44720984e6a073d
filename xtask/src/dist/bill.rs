//! Validates the bills of materials against CycloneDX.

use std::path::{Path, PathBuf};

use anyhow::Result;
use xshell::cmd;

use crate::install;
use crate::project::Project;

/// CycloneDX's own library, which contains the schema.
const LIBRARY: &str = "cyclonedx-python-lib[json-validation]==11.12.0";

/// Validates each bill against the schema, and its licences against SPDX's list.
const SCRIPT: &str = r#"
import json, sys
from cyclonedx.schema import SchemaVersion
from cyclonedx.validation.json import JsonStrictValidator
from license_expression import get_spdx_licensing

for path in sys.argv[1:]:
    text = open(path).read()
    error = JsonStrictValidator(SchemaVersion.V1_6).validate_str(text)
    if error:
        sys.exit(f"{path}: {error}")
    bill = json.loads(text)
    parts = [bill["metadata"]["component"]] + bill["components"]
    for part in parts:
        for licence in part["licenses"]:
            found = get_spdx_licensing().validate(licence["expression"])
            if found.errors:
                sys.exit(f"{path}: {part['name']}: {found.errors}")
    print(f"{path}: {len(parts)} parts, valid")
"#;

/// Installs CycloneDX's library; returns the Python that has it.
pub(crate) fn install_validator(project: &Project) -> Result<PathBuf> {
    let imports = "cyclonedx.validation.json, jsonschema, license_expression";
    install::environment(project, "bill", &[LIBRARY], imports)
}

pub(super) fn check(project: &Project, release: &Path) -> Result<()> {
    let sh = &project.sh;
    let python = install_validator(project)?;
    let mut bills = sh.read_dir(release)?;
    bills.retain(|path| path.to_string_lossy().ends_with(".cdx.json"));
    Ok(cmd!(sh, "{python} -c {SCRIPT} {bills...}").quiet().run()?)
}
