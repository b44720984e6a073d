//! Validates the bills of materials against CycloneDX.

use std::fs;
use std::path::Path;

use crate::Dirs;
use crate::cmd::{Cmd, Outcome};

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

pub(super) fn check(dirs: &Dirs, release: &Path) -> Outcome {
    let venv = dirs.absolute("bill");
    let python = venv.join("bin/python");
    let works = || {
        Cmd::program(&python)
            .args("-c")
            .arg("import cyclonedx.validation.json, jsonschema, license_expression")
            .stdout()
    };
    if works().is_err() {
        Cmd::new("python3 -m venv --clear").arg(&venv).run()?;
        Cmd::program(&python)
            .args("-m pip install --disable-pip-version-check --quiet")
            .arg(LIBRARY)
            .run()?;
        works()?;
    }
    let entries = fs::read_dir(release);
    let entries = entries.map_err(|error| format!("{}: {error}", release.display()))?;
    let mut check = Cmd::program(&python).args("-c").arg(SCRIPT);
    for entry in entries.flatten() {
        if entry.file_name().to_string_lossy().ends_with(".cdx.json") {
            check = check.arg(entry.path());
        }
    }
    print!("{}", check.stdout()? + "\n");
    Ok(())
}
