//! The shared library, made from the one object.

use std::path::Path;

use anyhow::Result;
use xshell::{Cmd, Shell, cmd};

/// Version of the shared library's interface, as `ZTL_ABI`.
pub(super) const NAME: &str = "libztl.so.1";

/// Libraries that a program must link as well.
pub(super) const SYSTEM: [&str; 4] = ["-lpthread", "-ldl", "-lm", "-lrt"];

/// Links the object into `lib/`.
pub(super) fn link(compiler: Cmd<'_>, object: &Path, lib: &Path, options: &[&str]) -> Result<()> {
    let link = compiler.args(["-shared", "-s", "-Wl,-z,defs", "-Wl,--gc-sections"]);
    let link = link
        .arg(format!("-Wl,-soname,{NAME}"))
        .arg("-o")
        .arg(lib.join(NAME));
    Ok(link.arg(object).args(options).args(SYSTEM).run()?)
}

/// Creates the link and the description by which the shared library in `lib/` is found.
pub(super) fn name(sh: &Shell, lib: &Path) -> Result<()> {
    cmd!(sh, "ln -sf {NAME} {lib}/libztl.so").quiet().run()?;
    // Relative paths: works wherever the directory is put.
    let text = format!(
        "prefix=${{pcfiledir}}/../..\n\n\
         Name: ztl\n\
         Description: serve tasks to ZTL's clients, and have tasks done\n\
         Version: {version}\n\
         Cflags: -I${{prefix}}/include\n\
         Libs: -L${{prefix}}/lib -lztl\n\
         Libs.private: {system}\n",
        version = env!("CARGO_PKG_VERSION"),
        system = SYSTEM.join(" "),
    );
    Ok(sh.write_file(lib.join("pkgconfig/ztl.pc"), text)?)
}
