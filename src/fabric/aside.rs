//! Files that are whole or not there.

use crate::base::{Context, Result};
use std::io::{BufWriter, Write};
use std::os::unix::fs::PermissionsExt;
use std::path::Path;

/// Writes a file aside, in the folder it belongs to, and renames it when it is whole.
///
/// # Errors
/// The file cannot be written, or `write` fails; nothing is left behind then.
pub(crate) fn write_aside<T>(
    out: &Path,
    write: impl FnOnce(&mut dyn Write) -> Result<T>,
) -> Result<T> {
    let what = || format!("{} cannot be written", out.display());
    let folder = out.parent().filter(|f| !f.as_os_str().is_empty());
    let aside = tempfile::NamedTempFile::new_in(folder.unwrap_or(Path::new("."))).context(what)?;
    let mut file = BufWriter::with_capacity(1 << 20, aside);
    let result = write(&mut file)?;
    let whole = file
        .into_inner()
        .map_err(std::io::IntoInnerError::into_error)
        .context(what)?;
    // Files made aside are private until they are whole; results are not.
    let readable = std::fs::Permissions::from_mode(0o644);
    whole.as_file().set_permissions(readable).context(what)?;
    whole.as_file().sync_all().context(what)?;
    whole.persist(out).context(what)?;
    Ok(result)
}
