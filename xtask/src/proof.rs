//! Proves by linking that outside data reaches no panic in the no_std crates.
//!
//! The panic handler of the image `no-panic` calls a function that is never defined, so the image links only
//! if the compiler finds every panic unreachable.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail, ensure};
use xshell::Shell;

use crate::bare::must_fail;
use crate::cross::{Core, SMALLEST};
use crate::project::Project;
use crate::{image, lock};

const IMAGE: &str = "no-panic";

/// The part of the image's source with the ready components.
const PROOF: &str = "proof/src/bin/no_panic/device.rs";

/// The ready components; the image must create each of them.
const COMPONENTS: &str = "ztl-mcu/src/components";

/// Referenced only by the panic handler.
const SYMBOL: &str = "undefined symbol: a_panic_is_reachable";

pub(crate) fn prove(project: &Project) -> Result<()> {
    lock::check(&project.sh, image::MANIFEST)?;
    let unproven = unproven(&project.sh)?;
    ensure!(unproven.is_empty(), "{PROOF} does not create {unproven:?}");
    let core = Core::provide(&project.sh, SMALLEST)?;
    // No other step lints the images. Debian's compiler is not the one that clippy belongs to.
    if let Core::Compiled(_) = core {
        let clippy = core.cargo(project, "clippy", SMALLEST, "image")?;
        clippy
            .args(["--manifest-path", image::MANIFEST, "--", "-D", "warnings"])
            .run()?;
    }

    let (build, _) = image::build(project, &core, SMALLEST, IMAGE, "")?;
    println!("$ {build}");
    let output = build.ignore_status().output()?;
    let stderr = String::from_utf8_lossy(&output.stderr);
    if stderr.contains(SYMBOL) {
        let places = places(project, &core)?;
        bail!("a panic is reachable from outside, at one of these positions:\n{places}");
    }
    if !output.status.success() {
        bail!("the image does not build:\n{stderr}");
    }
    println!("links without a panic handler: no panic is reachable");

    // An image with an indexing that can panic.
    let (build, _) = image::build(project, &core, SMALLEST, IMAGE, "broken")?;
    must_fail(build, SYMBOL)
}

/// Ready components that the proof's image does not create.
fn unproven(sh: &Shell) -> Result<Vec<String>> {
    let proof = sh.read_file(PROOF)?;
    let mut components = Vec::new();
    let mut directories = vec![PathBuf::from(COMPONENTS)];
    while let Some(directory) = directories.pop() {
        for path in sh.read_dir(&directory)? {
            if sh.path_exists(path.join(".")) {
                directories.push(path);
            } else {
                components.extend(ready_components(&sh.read_file(&path)?));
            }
        }
    }
    components.retain(|name| !proof.contains(&format!("{name}::new(")));
    Ok(components)
}

/// The names in `impl<...> Component for NAME<...>`, outside of indented test code.
fn ready_components(source: &str) -> impl Iterator<Item = String> {
    let impls = source.lines().filter(|line| line.starts_with("impl<"));
    impls.filter_map(|line| {
        let (_, name) = line.split_once("> Component for ")?;
        let (name, _) = name.split_once('<')?;
        Some(name.to_owned())
    })
}

/// Positions of the remaining panics, one per line.
fn places(project: &Project, core: &Core) -> Result<String> {
    let (build, path) = image::build(project, core, SMALLEST, IMAGE, "explain")?;
    build.run()?;
    let places = image::panic_places(&path)?;
    let lines: Vec<String> = places
        .iter()
        .map(|place| format!("    {}", short(place, &project.root)))
        .collect();
    Ok(lines.join("\n"))
}

/// The position without machine-specific parts.
fn short<'a>(place: &'a str, root: &Path) -> &'a str {
    if let Ok(ours) = Path::new(place).strip_prefix(root) {
        return ours.to_str().unwrap_or(place);
    }
    // .../registry/src/NAME/CRATE-VERSION/..., and .../library/core/...
    let registry = place.split_once("/registry/src/");
    let package = registry.and_then(|(_, rest)| rest.split_once('/'));
    let library = place.split_once("/library/");
    package.or(library).map_or(place, |(_, rest)| rest)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_proof_creates_every_ready_component() {
        let sh = Shell::new().unwrap();
        sh.change_dir(concat!(env!("CARGO_MANIFEST_DIR"), "/.."));
        let unproven = unproven(&sh).unwrap();
        assert_eq!(unproven, <[&str; 0]>::default(), "add them to {PROOF}");
    }

    #[test]
    fn a_ready_component_is_recognized_by_its_impl() {
        let source =
            "impl<P: OutputPin> Component for DigitalOutput<P> {\n    impl Component for Fake {}\n";
        let found: Vec<String> = ready_components(source).collect();
        assert_eq!(found, ["DigitalOutput"]);
    }

    #[test]
    fn positions_are_shown_without_machine_specific_paths() {
        let root = Path::new("/home/me/ztl");
        for (place, told) in [
            (
                "/home/me/ztl/ztl-core/src/sink.rs:80:18",
                "ztl-core/src/sink.rs:80:18",
            ),
            (
                "/home/me/.cargo/registry/src/index-1949cf8c/heapless-0.9.3/src/vec/mod.rs:14:3",
                "heapless-0.9.3/src/vec/mod.rs:14:3",
            ),
            (
                "/rustc/5980761/library/core/src/str/pattern.rs:4:5",
                "core/src/str/pattern.rs:4:5",
            ),
            ("src/a.rs:1:2", "src/a.rs:1:2"),
        ] {
            assert_eq!(short(place, root), told);
        }
    }
}
