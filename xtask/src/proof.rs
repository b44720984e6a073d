//! Shows by linking that bytes from outside reach no panic in the no_std crates.
//!
//! The panic handler of the image `no-panic` calls a function that nobody defines, so the image
//! links only when the compiler has found every panic unreachable.

use std::path::Path;

use crate::Dirs;
use crate::cmd::Outcome;
use crate::cross::{Core, SMALLEST};
use crate::image;

const IMAGE: &str = "no-panic";

/// What only the panic handler asks for.
const SYMBOL: &str = "undefined symbol: a_panic_is_reachable";

pub(crate) fn prove(dirs: &Dirs) -> Outcome {
    image::check_lock()?;
    let core = Core::provide(SMALLEST)?;

    let (build, _) = image::build(dirs, &core, SMALLEST, IMAGE, "")?;
    println!("$ {build}");
    let (success, _, stderr) = build.capture()?;
    if !success && stderr.contains(SYMBOL) {
        return Err(format!(
            "a panic can be reached from outside, at one of these places:\n{}",
            places(dirs, &core)?
        ));
    }
    if !success {
        return Err(format!("`{build}` failed:\n{stderr}"));
    }
    println!("links without a panic handler: no panic is reachable");

    let (build, _) = image::build(dirs, &core, SMALLEST, IMAGE, "broken")?;
    println!("$ {build}    (has to fail)");
    match build.capture()? {
        (true, ..) => Err(
            "an image with an indexing that can panic links, so this step would not notice one; \
             mend the panic handler (proof/src/bin/no_panic.rs)"
                .to_owned(),
        ),
        (false, _, stderr) if !stderr.contains(SYMBOL) => Err(format!(
            "the image that can panic was refused for another reason than \"{SYMBOL}\":\n{stderr}"
        )),
        _ => {
            println!("refused, as it has to be: {SYMBOL}");
            Ok(())
        }
    }
}

/// Where the panics stand that the compiler has left in, a line each.
fn places(dirs: &Dirs, core: &Core) -> Outcome<String> {
    let (build, path) = image::build(dirs, core, SMALLEST, IMAGE, "explain")?;
    build.run()?;
    let places = image::panic_places(&path)?;
    if places.is_empty() {
        return Ok("    (the image does not tell)".to_owned());
    }
    let lines: Vec<String> = places
        .iter()
        .map(|place| {
            let place = Path::new(place);
            let place = place.strip_prefix(&dirs.root).unwrap_or(place);
            format!("    {}", place.display())
        })
        .collect();
    Ok(lines.join("\n"))
}
