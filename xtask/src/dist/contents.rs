//! The contents of a static program: a bill of materials in CycloneDX, and the texts of all licences.

#![expect(
    clippy::indexing_slicing,
    reason = "indexing JSON by name gives null for missing keys"
)]

use std::collections::{BTreeMap, BTreeSet};
use std::fs;
use std::path::{Path, PathBuf};

use serde_json::{Value, json};

use crate::cmd::{Cmd, Outcome};
use crate::cross;
use crate::curve::Libraries;
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
    pub(super) fn of(zig: &Zig, target: Target, libraries: &Libraries) -> Outcome<Self> {
        let mut crates = crates(target)?;
        let own = crates.iter().position(|part| part.name == "ztl-std");
        let own = own.ok_or("cargo does not list the package ztl-std")?;
        Ok(Self {
            target,
            own: crates.remove(own),
            crates,
            foreign: foreign(zig, libraries)?,
        })
    }

    /// Compilers and foreign libraries with their versions, for `ztl --version`. libzmq is left out: `ztl`
    /// reports it itself.
    pub(super) fn tools(&self) -> String {
        let foreign = self.foreign.iter().filter(|part| part.name != "libzmq");
        let tools = foreign.map(|part| match part.name.as_str() {
            "rust-std" => format!("rustc {}", part.version),
            name => format!("{name} {}", part.version),
        });
        tools.collect::<Vec<_>>().join(", ")
    }

    /// Writes `ztl-TARGET.cdx.json`, and `LICENSES.txt`, which is the same for all targets.
    pub(super) fn write(&self, program: &Path, commit: &str) -> Outcome {
        let parts: Vec<&Part> = self.crates.iter().chain(&self.foreign).collect();
        let sum = Cmd::new("sha256sum").arg(program).stdout()?;
        let sum = sum.split_whitespace().next().unwrap_or_default();
        let bill = bill(&self.own, &parts, self.target, commit, sum);
        let name = format!("ztl-{}.cdx.json", self.target.name);
        for (name, text) in [
            (name.as_str(), format!("{bill:#}\n")),
            ("LICENSES.txt", licences(&self.own, &parts)?),
        ] {
            let path = program.with_file_name(name);
            fs::write(&path, text)
                .map_err(|error| format!("cannot write {}: {error}", path.display()))?;
        }
        Ok(())
    }
}

/// The Rust packages, including `ztl` itself.
fn crates(target: Target) -> Outcome<Vec<Part>> {
    let metadata = Cmd::new("cargo metadata --format-version 1 --locked --filter-platform")
        .arg(target.triple)
        .stdout()?;
    let metadata: Value = serde_json::from_str(&metadata)
        .map_err(|error| format!("cannot parse the output of `cargo metadata`: {error}"))?;
    let checksums = checksums()?;
    let list = |value: &Value| value.as_array().cloned().unwrap_or_default();
    let text = |value: &Value| value.as_str().unwrap_or_default().to_owned();
    let nodes: BTreeMap<String, Value> = list(&metadata["resolve"]["nodes"])
        .into_iter()
        .map(|node| (text(&node["id"]), node))
        .collect();
    let packages: BTreeMap<String, Value> = list(&metadata["packages"])
        .into_iter()
        .map(|package| (text(&package["id"]), package))
        .collect();
    let mut wanted: Vec<String> = packages
        .iter()
        .filter(|(_, package)| package["name"] == "ztl-std")
        .map(|(id, _)| id.clone())
        .collect();
    let mut found = BTreeSet::new();
    while let Some(id) = wanted.pop() {
        if !found.insert(id.clone()) {
            continue;
        }
        for dependency in list(nodes.get(&id).map_or(&Value::Null, |node| &node["deps"])) {
            // Build-time and test dependencies are not inside.
            let kinds = list(&dependency["dep_kinds"]);
            if kinds.iter().any(|kind| kind["kind"].is_null()) && !is_macro(&packages, &dependency)
            {
                wanted.push(text(&dependency["pkg"]));
            }
        }
    }
    let part = |id: &String| {
        let package = packages.get(id)?;
        let (name, version) = (text(&package["name"]), text(&package["version"]));
        let home = PathBuf::from(text(&package["manifest_path"]));
        let licence = text(&package["license"]).replace('/', " OR ");
        let texts = |home: &Path| match texts_in(home) {
            // Without its own text: Apache's licence contains no names.
            none if none.is_empty() && licence.contains("Apache-2.0") => {
                vec![PathBuf::from("LICENSE-APACHE")]
            }
            some => some,
        };
        Some(Part {
            url: format!("pkg:cargo/{name}@{version}"),
            sha256: checksums.get(&(name.clone(), version.clone())).cloned(),
            texts: home.parent().map(texts).unwrap_or_default(),
            licence,
            name,
            version,
        })
    };
    Ok(found.iter().filter_map(part).collect())
}

/// Whether it is a macro, which only the compiler runs.
fn is_macro(packages: &BTreeMap<String, Value>, dependency: &Value) -> bool {
    let id = dependency["pkg"].as_str().unwrap_or_default();
    let targets = packages
        .get(id)
        .and_then(|package| package["targets"].as_array());
    targets.is_some_and(|targets| {
        targets.iter().any(|target| {
            target["kind"]
                .as_array()
                .is_some_and(|kinds| kinds.contains(&json!("proc-macro")))
        })
    })
}

/// The checksums in `Cargo.lock`, by name and version.
fn checksums() -> Outcome<BTreeMap<(String, String), String>> {
    let lock = fs::read_to_string("Cargo.lock")
        .map_err(|error| format!("cannot read Cargo.lock: {error}"))?;
    let value = |package: &str, key: &str| {
        let line = package.lines().find_map(|line| line.strip_prefix(key))?;
        Some(
            line.trim_matches(|c| c == ' ' || c == '=' || c == '"')
                .to_owned(),
        )
    };
    let packages = lock.split("[[package]]");
    let known = packages.filter_map(|package| {
        let key = (value(package, "name =")?, value(package, "version =")?);
        Some((key, value(package, "checksum =")?))
    });
    Ok(known.collect())
}

/// The files of a package that contain its licence.
fn texts_in(home: &Path) -> Vec<PathBuf> {
    let names = [
        "LICENSE",
        "LICENCE",
        "COPYING",
        "NOTICE",
        "COPYRIGHT",
        "UNLICENSE",
    ];
    let entries = fs::read_dir(home).into_iter().flatten().flatten();
    let mut files: Vec<PathBuf> = entries
        .map(|entry| entry.path())
        .filter(|path| {
            let name = path
                .file_name()
                .unwrap_or_default()
                .to_string_lossy()
                .to_uppercase();
            path.is_file() && names.iter().any(|begin| name.starts_with(begin))
        })
        .collect();
    files.sort();
    files
}

/// The libraries in C and C++, and Rust's own.
fn foreign(zig: &Zig, libraries: &Libraries) -> Outcome<Vec<Part>> {
    let sources = zig.sources()?;
    let lock = fs::read_to_string("libzmq/Cargo.lock")
        .map_err(|error| format!("cannot read libzmq/Cargo.lock: {error}"))?;
    let (_, version) = lock
        .split_once("name = \"zeromq-src\"\nversion = \"")
        .ok_or("libzmq/Cargo.lock does not list zeromq-src")?;
    let version = version.split('"').next().unwrap_or_default();
    let zmq = version.split_once('+').map_or(version, |(_, zmq)| zmq);
    let home = env_home().join("registry/src");
    let zmq_home = fs::read_dir(&home)
        .into_iter()
        .flatten()
        .flatten()
        .map(|entry| entry.path().join(format!("zeromq-src-{version}/vendor")))
        .find(|path| path.exists())
        .ok_or_else(|| format!("no zeromq-src-{version} below {}", home.display()))?;

    let sodium = Path::new(&libraries.sodium);
    let header = sodium.join("../include/sodium/version.h");
    let text = fs::read_to_string(&header)
        .map_err(|error| format!("cannot read {}: {error}", header.display()))?;
    let sodium_version = text
        .split_once("SODIUM_VERSION_STRING \"")
        .and_then(|(_, rest)| rest.split('"').next())
        .ok_or_else(|| format!("{} does not contain the version", header.display()))?;

    let config = sources.join("libcxx/include/__config");
    let text = fs::read_to_string(&config)
        .map_err(|error| format!("cannot read {}: {error}", config.display()))?;
    let number = text
        .split_once("define _LIBCPP_VERSION ")
        .and_then(|(_, rest)| rest.lines().next()?.trim().parse::<u32>().ok())
        .ok_or_else(|| format!("{} does not contain the version", config.display()))?;
    let llvm = format!(
        "{}.{}.{}",
        number / 10_000,
        number / 100 % 100,
        number % 100
    );

    let rust = Cmd::program(cross::DEBIAN_RUSTC)
        .arg("--version")
        .stdout()?;
    let rust = rust
        .split_whitespace()
        .nth(1)
        .unwrap_or_default()
        .to_owned();
    let part = |name: &str, version: &str, licence: &str, url: String, text: PathBuf| Part {
        name: name.to_owned(),
        version: version.to_owned(),
        licence: licence.to_owned(),
        url,
        sha256: None,
        texts: vec![text],
    };
    let apache = "Apache-2.0 WITH LLVM-exception";
    let from_llvm = |name: &str, directory: &str| {
        let text = sources.join(directory).join("LICENSE.TXT");
        let url = format!("pkg:github/llvm/llvm-project@llvmorg-{llvm}#{directory}");
        part(name, &llvm, apache, url, text)
    };
    Ok(vec![
        part(
            "rust-std",
            &rust,
            "MIT OR Apache-2.0",
            format!("pkg:github/rust-lang/rust@{rust}#library"),
            PathBuf::from("/usr/share/doc/rustc-web/copyright"),
        ),
        part(
            "libzmq",
            zmq,
            "MPL-2.0",
            format!("pkg:github/zeromq/libzmq@v{zmq}"),
            zmq_home.join("LICENSE"),
        ),
        part(
            "libsodium",
            sodium_version,
            "ISC",
            format!("pkg:github/jedisct1/libsodium@{sodium_version}"),
            sodium.join("../../source/libsodium-stable/LICENSE"),
        ),
        part(
            "musl",
            MUSL,
            "MIT",
            format!("pkg:generic/musl@{MUSL}"),
            sources.join("libc/musl/COPYRIGHT"),
        ),
        from_llvm("libc++", "libcxx"),
        from_llvm("libc++abi", "libcxxabi"),
        from_llvm("libunwind", "libunwind"),
        // zig's compiler runtime, and its replacements for parts of musl.
        part(
            "zig",
            ZIG,
            "MIT",
            format!("pkg:pypi/ziglang@{ZIG}"),
            sources.with_file_name("LICENSE"),
        ),
    ])
}

fn env_home() -> PathBuf {
    let set = |name| std::env::var_os(name).map(PathBuf::from);
    set("CARGO_HOME").unwrap_or_else(|| set("HOME").unwrap_or_default().join(".cargo"))
}

fn bill(own: &Part, parts: &[&Part], target: Target, commit: &str, sum: &str) -> Value {
    let component = |kind: &str, part: &Part| {
        let mut component = json!({
            "type": kind,
            "bom-ref": part.url,
            "name": part.name,
            "version": part.version,
            "purl": part.url,
            "licenses": [{ "expression": part.licence }],
        });
        if let Some(sum) = &part.sha256 {
            component["hashes"] = json!([{ "alg": "SHA-256", "content": sum }]);
        }
        component
    };
    let mut program = component("application", own);
    program["name"] = json!("ztl");
    program["hashes"] = json!([{ "alg": "SHA-256", "content": sum }]);
    program["properties"] = json!([
        { "name": "ztl:target", "value": target.triple },
        { "name": "ztl:commit", "value": commit },
    ]);
    let parts: Vec<Value> = parts
        .iter()
        .map(|&part| component("library", part))
        .collect();
    json!({
        "$schema": "http://cyclonedx.org/schema/bom-1.6.schema.json",
        "bomFormat": "CycloneDX",
        "specVersion": "1.6",
        "version": 1,
        "metadata": { "component": program },
        "components": parts,
    })
}

/// All licence texts, each once, with the components they apply to.
fn licences(own: &Part, parts: &[&Part]) -> Outcome<String> {
    let mut all = format!(
        "What is inside ztl {}, and under which licence. libzmq is unchanged; its source is in the crate\n\
         zeromq-src at crates.io, and at https://github.com/zeromq/libzmq.\n\n",
        own.version
    );
    let mut texts: BTreeMap<String, BTreeSet<String>> = BTreeMap::new();
    for part in std::iter::once(&own).chain(parts) {
        let name = format!("{} {}", part.name, part.version);
        if part.texts.is_empty() {
            return Err(format!("{name} has no licence text"));
        }
        all += &format!("  {name}: {}\n", part.licence);
        for path in &part.texts {
            let text = fs::read(path)
                .map_err(|error| format!("cannot read {}: {error}", path.display()))?;
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
    use crate::zig::TARGETS;

    #[test]
    fn runtime_dependencies_are_listed_and_build_dependencies_are_not() {
        // Cargo runs tests in their package's directory.
        std::env::set_current_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/..")).unwrap();
        let mut parts = crates(TARGETS[0]).unwrap();
        let names: BTreeSet<&str> = parts.iter().map(|part| part.name.as_str()).collect();
        for name in [
            "ztl-std",
            "ztl-core",
            "zmq",
            "zmq-sys",
            "clap",
            "serde_json",
        ] {
            assert!(names.contains(name), "{name} in {names:?}");
        }
        for name in [
            "xtask",
            "clap_derive",
            "serde_derive",
            "cc",
            "zeromq-src",
            "windows-sys",
        ] {
            assert!(!names.contains(name), "{name} in {names:?}");
        }
        for part in &parts {
            assert!(!part.licence.is_empty(), "{} has no licence", part.name);
            let own = part.name.starts_with("ztl-");
            assert_eq!(part.sha256.as_ref().map(String::len), (!own).then_some(64));
        }
        let own = parts
            .iter()
            .position(|part| part.name == "ztl-std")
            .unwrap();
        let own = parts.remove(own);
        let parts: Vec<&Part> = parts.iter().collect();
        let bill = bill(&own, &parts, TARGETS[0], "0123", "4567");
        assert_eq!(bill["metadata"]["component"]["name"], "ztl");
        assert_eq!(bill["components"].as_array().unwrap().len(), parts.len());
        let text = licences(&own, &parts).unwrap();
        assert!(text.contains("  zmq 0.10.0: MIT OR Apache-2.0\n"), "{text}");
        assert!(text.contains("Permission is hereby granted"));
    }
}
