//! The contents of a static program: a bill of materials in CycloneDX, and the texts of all licences.
//!
//! Not by `cargo-cyclonedx` and `cargo-about`: they know only Cargo packages, so the C and C++ libraries, Rust's own and
//! the program's checksum would still be written here.

use std::collections::{BTreeMap, BTreeSet};
use std::env;
use std::path::{Path, PathBuf};

use anyhow::{Context as _, Result};
use serde_json::{Value, json};
use xshell::{Shell, cmd};

use super::Program;
use crate::cross;
use crate::lock;
use crate::project::Project;
use crate::zig::{MUSL, Target, ZIG, Zig};

/// A component of the program.
struct Part {
    name: String,
    version: String,
    /// An SPDX expression.
    licence: String,
    /// Its origin (a package URL, `purl`).
    url: String,
    /// Checksum of the archive on crates.io.
    sha256: Option<String>,
    /// Files with the licence text.
    texts: Vec<PathBuf>,
}

/// Everything inside the program for a target.
pub(super) struct Contents {
    target: Target,
    own: Part,
    crates: Vec<Part>,
    /// Everything except Rust packages.
    foreign: Vec<Part>,
}

impl Contents {
    /// Collects the contents.
    pub(super) fn of(
        project: &Project,
        zig: &Zig<'_>,
        program: &Program,
        target: Target,
    ) -> Result<Self> {
        let mut crates = crates(&project.sh, program, target)?;
        let own = crates.iter().position(|part| part.name == program.package);
        let own = own.context("cargo does not list the package of the program")?;
        Ok(Self {
            target,
            own: crates.remove(own),
            crates,
            foreign: foreign(&project.sh, zig)?,
        })
    }

    /// Compilers and foreign libraries with their versions, for `ztl --version`.
    pub(super) fn tools(&self) -> String {
        let tools = self.foreign.iter().map(|part| match part.name.as_str() {
            "rust-std" => format!("rustc {}", part.version),
            name => format!("{name} {}", part.version),
        });
        tools.collect::<Vec<_>>().join(", ")
    }

    /// Writes `PROGRAM-TARGET.cdx.json` and `PROGRAM-TARGET.licenses.txt`.
    pub(super) fn write(&self, sh: &Shell, program: &Path, commit: &str) -> Result<()> {
        let parts: Vec<&Part> = self.crates.iter().chain(&self.foreign).collect();
        let sum = cmd!(sh, "sha256sum {program}").read()?;
        let sum = sum.split(' ').next().unwrap_or_default();
        let bill = bill(&self.own, &parts, self.target, commit, sum);
        sh.write_file(program.with_extension("cdx.json"), format!("{bill:#}\n"))?;
        let licences = licences(sh, &self.own, &parts)?;
        Ok(sh.write_file(program.with_extension("licenses.txt"), licences)?)
    }
}

/// The Rust packages, including the program's; neither macros nor what only the build needs.
fn crates(sh: &Shell, program: &Program, target: Target) -> Result<Vec<Part>> {
    let triple = target.triple();
    let Program { package, features } = program;
    let tree =
        "tree --locked --edges normal,no-proc-macro --prefix none --format {p}|{l}".split(' ');
    let tree = cmd!(sh, "cargo {tree...}").args(features(target));
    let tree = tree
        .args(["--package", package, "--target", &triple])
        .read()?;
    let lines = tree.lines().map(|line| line.trim_end_matches(" (*)"));
    let lines: BTreeSet<&str> = lines.collect();
    let locked = lock::packages(&sh.read_file("Cargo.lock")?);
    let part = |line: &str| -> Result<Part> {
        // `zmq v0.10.0|MIT/Apache-2.0`; with a directory behind the version if it is ours.
        let (package, licence) = line.split_once('|').context("no licence")?;
        let (name, version) = package.split_once(" v").context("no version")?;
        let (version, own) = match version.split_once(" (") {
            Some((version, path)) => (version, Some(PathBuf::from(path.trim_end_matches(')')))),
            None => (version, None),
        };
        let home = own.map_or_else(|| source(sh, name, version), Ok)?;
        let mut locked = locked.iter().filter(|locked| locked.name == name);
        let package = locked.find(|locked| locked.version == version);
        let mut texts = texts(sh, &home)?;
        if texts.is_empty() && licence.contains("Apache-2.0") {
            // Apache's licence contains no names.
            texts.push("LICENSE-APACHE".into());
        }
        Ok(Part {
            name: name.to_owned(),
            version: version.to_owned(),
            licence: licence.replace('/', " OR "),
            url: format!("pkg:cargo/{name}@{version}"),
            sha256: package.and_then(|package| package.checksum.clone()),
            texts,
        })
    };
    let part = |line: &str| part(line).with_context(|| format!("`{line}`"));
    lines.into_iter().map(part).collect()
}

/// The directory of a package from crates.io.
fn source(sh: &Shell, name: &str, version: &str) -> Result<PathBuf> {
    let home = env::var("CARGO_HOME").or_else(|_| env::var("HOME").map(|home| home + "/.cargo"))?;
    let registries = sh.read_dir(Path::new(&home).join("registry/src"))?;
    let mut sources = registries
        .iter()
        .map(|path| path.join(format!("{name}-{version}")));
    let found = sources.find(|path| path.exists());
    found.context("the sources are missing")
}

/// The files of a package that contain its licence.
fn texts(sh: &Shell, home: &Path) -> Result<Vec<PathBuf>> {
    const NAMES: &str = "LICENSE LICENCE COPYING NOTICE COPYRIGHT UNLICENSE";
    let mut files = sh.read_dir(home)?;
    files.retain(|path| {
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        let name = name.to_uppercase();
        path.is_file() && NAMES.split(' ').any(|begin| name.starts_with(begin))
    });
    Ok(files)
}

/// The libraries in C, and Rust's own.
fn foreign(sh: &Shell, zig: &Zig<'_>) -> Result<Vec<Part>> {
    let sources = zig.sources()?;
    let config = sh.read_file(sources.join("libcxx/include/__config"))?;
    let number = between(&config, "define _LIBCPP_VERSION ", "\n")?;
    let number: u32 = number.trim().parse()?;
    let [major, minor, patch] = [number / 10_000, number / 100 % 100, number % 100];
    let llvm = format!("{major}.{minor}.{patch}");

    let rustc = cross::DEBIAN_RUSTC;
    let rust = cmd!(sh, "{rustc} --version").read()?;
    let rust = between(&rust, "rustc ", " ")?;

    let part = |name: &str, version: &str, licence: &str, url: String, text: PathBuf| Part {
        name: name.to_owned(),
        version: version.to_owned(),
        licence: licence.to_owned(),
        url: format!("pkg:{url}"),
        sha256: None,
        texts: vec![text],
    };
    let from_llvm = |name: &str, directory: &str| {
        let url = format!("github/llvm/llvm-project@llvmorg-{llvm}#{directory}");
        let text = sources.join(directory).join("LICENSE.TXT");
        part(name, &llvm, "Apache-2.0 WITH LLVM-exception", url, text)
    };
    let rust_url = format!("github/rust-lang/rust@{rust}#library");
    let rust_text = PathBuf::from("/usr/share/doc/rustc-web/copyright");
    let musl_url = format!("generic/musl@{MUSL}");
    let musl_text = sources.join("libc/musl/COPYRIGHT");
    let zig_url = format!("pypi/ziglang@{ZIG}");
    // zig's compiler runtime, and its replacements for parts of musl.
    let zig_text = sources.with_file_name("LICENSE");
    Ok(vec![
        part("rust-std", rust, "MIT OR Apache-2.0", rust_url, rust_text),
        part("musl", MUSL, "MIT", musl_url, musl_text),
        from_llvm("libunwind", "libunwind"),
        part("zig", ZIG, "MIT", zig_url, zig_text),
    ])
}

fn between<'a>(text: &'a str, before: &str, after: &str) -> Result<&'a str> {
    let found = text.split_once(before);
    let found = found.and_then(|(_, rest)| rest.split_once(after));
    Ok(found.with_context(|| format!("`{before}` is missing"))?.0)
}

fn bill(own: &Part, parts: &[&Part], target: Target, commit: &str, sum: &str) -> Value {
    let component = |kind: &str, part: &Part, name: &str, sha256: Option<&str>| {
        let mut component = json!({
            "type": kind,
            "bom-ref": part.url,
            "name": name,
            "version": part.version,
            "purl": part.url,
            "licenses": [{ "expression": part.licence }],
        });
        if let (Some(sum), Some(fields)) = (sha256, component.as_object_mut()) {
            let hashes = json!([{ "alg": "SHA-256", "content": sum }]);
            fields.insert("hashes".to_owned(), hashes);
        }
        component
    };
    let mut program = component("application", own, &own.name, Some(sum));
    if let Some(fields) = program.as_object_mut() {
        let properties = json!([
            { "name": "ztl:target", "value": target.triple() },
            { "name": "ztl:commit", "value": commit },
        ]);
        fields.insert("properties".to_owned(), properties);
    }
    let library = |part: &&Part| component("library", part, &part.name, part.sha256.as_deref());
    let libraries: Vec<Value> = parts.iter().map(library).collect();
    json!({
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": { "component": program },
        "components": libraries,
    })
}

/// All licence texts, each once, with the components they apply to.
fn licences(sh: &Shell, own: &Part, parts: &[&Part]) -> Result<String> {
    let (name, version) = (&own.name, &own.version);
    let mut all = format!("The parts of {name} {version}, and their licences.\n\n");
    let mut texts: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for part in std::iter::once(&own).chain(parts) {
        let name = format!("{} {}", part.name, part.version);
        let note = match part.texts.is_empty() {
            true => " (its package has no text)",
            false => "",
        };
        all += &format!("  {name}: {}{note}\n", part.licence);
        for path in &part.texts {
            let text = sh.read_binary_file(path)?;
            let text = String::from_utf8_lossy(&text).trim().replace('\r', "");
            texts.entry(text).or_default().insert(name.clone());
        }
    }
    for (text, names) in texts {
        let names: Vec<String> = names.into_iter().collect();
        all += &format!("\n{}\n{}\n\n{text}\n", "=".repeat(78), names.join(", "));
    }
    Ok(all)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::dist::ZTL;
    use crate::project::PACKAGE;
    use crate::zig::targets;

    #[test]
    fn runtime_dependencies_are_listed_and_build_dependencies_are_not() {
        let sh = &Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let target = targets(&["x86_64"]).unwrap()[0];
        let parts = crates(sh, &ZTL, target).unwrap();
        let names: BTreeSet<&str> = parts.iter().map(|part| part.name.as_str()).collect();
        for name in "ztl ztl-std ztl-core crypto_box mio clap serde_json".split(' ') {
            assert!(names.contains(name), "{name} in {names:?}");
        }
        for name in "xtask clap_derive serde_derive cc zmq zmq-sys windows-sys".split(' ') {
            assert!(!names.contains(name), "{name} in {names:?}");
        }
        for part in &parts {
            assert!(!part.licence.is_empty(), "{} has no licence", part.name);
            let own = part.name.starts_with("ztl");
            assert_eq!(part.sha256.as_ref().map(String::len), (!own).then_some(64));
        }
        let own = parts.iter().find(|part| part.name == PACKAGE).unwrap();
        let parts: Vec<&Part> = parts.iter().filter(|part| part.name != PACKAGE).collect();
        let bill = bill(own, &parts, target, "0123", "4567");
        assert_eq!(bill["metadata"]["component"]["name"], "ztl");
        assert_eq!(bill["components"].as_array().unwrap().len(), parts.len());
        let text = licences(sh, own, &parts).unwrap();
        assert!(
            text.contains("  crypto_box 0.9.1: Apache-2.0 OR MIT\n"),
            "{text}"
        );
        assert!(text.contains("Permission is hereby granted"));
    }
}
