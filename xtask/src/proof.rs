//! Proves by linking that outside data reaches no panic in the no_std crates.
//!
//! The panic handler of the image `no-panic` calls a function that is never defined, so the image links only
//! if the compiler finds every panic unreachable.

use std::path::Path;

use anyhow::{Result, bail};

use crate::bare::must_fail;
use crate::cross::{Core, SMALLEST};
use crate::project::Project;
use crate::{image, lock};

const IMAGE: &str = "no-panic";

/// Referenced only by the panic handler.
const SYMBOL: &str = "undefined symbol: a_panic_is_reachable";

pub(crate) fn prove(project: &Project) -> Result<()> {
    lock::check(&project.sh, image::MANIFEST)?;
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
