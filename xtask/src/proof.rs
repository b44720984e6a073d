//! Proves by linking that outside data reaches no panic in the no_std crates.
//!
//! The panic handler of the image `no-panic` calls a function that is never defined, so the image links only
//! if the compiler finds every panic unreachable.

use std::path::Path;

use crate::Dirs;
use crate::cmd::Outcome;
use crate::cross::{Core, SMALLEST};
use crate::image;

const IMAGE: &str = "no-panic";

/// Referenced only by the panic handler.
const SYMBOL: &str = "undefined symbol: a_panic_is_reachable";

pub(crate) fn prove(dirs: &Dirs) -> Outcome {
    image::check_lock(image::MANIFEST)?;
    let core = Core::provide(SMALLEST)?;
    lint(dirs, &core)?;

    let (build, _) = image::build(dirs, &core, SMALLEST, IMAGE, "")?;
    println!("$ {build}");
    let (success, _, stderr) = build.capture()?;
    if !success && stderr.contains(SYMBOL) {
        return Err(format!(
            "a panic is reachable from outside, at one of these positions:\n{}",
            places(dirs, &core)?
        ));
    }
    if !success {
        return Err(format!("`{build}` failed:\n{stderr}"));
    }
    println!("links without a panic handler: no panic is reachable");

    let (build, _) = image::build(dirs, &core, SMALLEST, IMAGE, "broken")?;
    println!("$ {build}    (must fail)");
    match build.capture()? {
        (true, ..) => Err(
            "an image with an indexing that can panic links, so this step would not notice one; \
             mend the panic handler (proof/src/bin/no_panic.rs)"
                .to_owned(),
        ),
        (false, _, stderr) if !stderr.contains(SYMBOL) => Err(format!(
            "the image that can panic failed for another reason than \"{SYMBOL}\":\n{stderr}"
        )),
        _ => {
            println!("failed as expected: {SYMBOL}");
            Ok(())
        }
    }
}

/// The images are not in the workspace, so no other step lints them. Only with the compiler that clippy
/// belongs to, not with Debian's.
fn lint(dirs: &Dirs, core: &Core) -> Outcome {
    match core {
        Core::Compiled(_) => core
            .cargo("clippy", SMALLEST, &dirs.target.join("image"))
            .args("--locked --manifest-path")
            .arg(image::MANIFEST)
            .args("-- -D warnings")
            .run(),
        Core::Source => Ok(()),
    }
}

/// Positions of the remaining panics, one per line.
fn places(dirs: &Dirs, core: &Core) -> Outcome<String> {
    let (build, path) = image::build(dirs, core, SMALLEST, IMAGE, "explain")?;
    build.run()?;
    let places = image::panic_places(&path)?;
    if places.is_empty() {
        return Ok("    (unknown)".to_owned());
    }
    let lines: Vec<String> = places
        .iter()
        .map(|place| format!("    {}", short(place, &dirs.root)))
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
