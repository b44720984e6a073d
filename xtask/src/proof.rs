//! Proves by linking that outside data reaches no panic in the no_std crates.
//!
//! The panic handler of the image `no-panic` calls a function that is never defined, so the image links only
//! if the compiler finds every panic unreachable.

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
    let lines: Vec<String> = places.iter().map(|place| format!("    {place}")).collect();
    Ok(lines.join("\n"))
}
