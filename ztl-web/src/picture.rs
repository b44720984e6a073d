//! Pictures in streams: JPEG and PNG as they are, arrays of bytes as BMP.

use ztl_pickle::{Array, DType, Kind, Pickle};
use ztl_std::publish::Content;

/// An array is thinned out until it is at most so wide and high.
const MOST: usize = 640;
/// The bytes before the first line of a BMP.
const HEADER: u32 = 54;

/// Whether a value is a picture.
pub(crate) fn is_one(content: &Content<'_>) -> bool {
    match content {
        Content::Value(value) => file(value).is_some() || array(value).is_some(),
        Content::Bytes(bytes) => kind(bytes).is_some(),
        Content::Text(_) | Content::Refused(_) => false,
    }
}

/// A picture for browsers, with its type.
pub(crate) fn of(content: &Content<'_>) -> Option<(&'static str, Vec<u8>)> {
    match content {
        Content::Bytes(bytes) => Some((kind(bytes)?, bytes.to_vec())),
        Content::Value(value) => match file(value) {
            Some((kind, bytes)) => Some((kind, bytes.to_vec())),
            None => Some(("image/bmp", bitmap(&array(value)?)?)),
        },
        Content::Text(_) | Content::Refused(_) => None,
    }
}

/// The type of a file, by how it begins.
fn kind(bytes: &[u8]) -> Option<&'static str> {
    match bytes {
        [0xff, 0xd8, 0xff, ..] => Some("image/jpeg"),
        [0x89, b'P', b'N', b'G', ..] => Some("image/png"),
        _ => None,
    }
}

fn file(value: &Pickle) -> Option<(&'static str, &[u8])> {
    match value.value().kind() {
        Kind::Bytes(bytes) | Kind::ByteArray(bytes) => Some((kind(bytes)?, bytes)),
        _ => None,
    }
}

/// Rows of pixels: grey, or red, green, blue and perhaps what is not shown.
struct Pixels<'a> {
    height: usize,
    width: usize,
    channels: usize,
    data: &'a [u8],
}

fn array(value: &Pickle) -> Option<Pixels<'_>> {
    let array: Array<'_> = match value.value().kind() {
        Kind::Array(array) if array.dtype() == DType::UINT8 && !array.is_fortran() => array,
        _ => return None,
    };
    let (height, width, channels) = match array.shape().as_slice() {
        [height, width] => (*height, *width, 1),
        [height, width, channels @ (1 | 3 | 4)] => (*height, *width, *channels),
        _ => return None,
    };
    let (data, is_picture) = (array.data(), height > 1 && width > 1);
    is_picture.then_some(Pixels {
        height,
        width,
        channels,
        data,
    })
}

fn bitmap(pixels: &Pixels<'_>) -> Option<Vec<u8>> {
    let step = pixels.width.max(pixels.height).div_ceil(MOST);
    let (width, height) = (pixels.width / step, pixels.height / step);
    // Each row ends at a multiple of four bytes.
    let padding = vec![0; (4 - width * 3 % 4) % 4];
    let size = u32::try_from(height * (width * 3 + padding.len())).ok()?;
    let mut out = Vec::new();
    out.extend(b"BM");
    for word in [HEADER.checked_add(size)?, 0, HEADER, 40] {
        out.extend(word.to_le_bytes());
    }
    out.extend(i32::try_from(width).ok()?.to_le_bytes());
    // Negative: the first row is the uppermost.
    out.extend((-i32::try_from(height).ok()?).to_le_bytes());
    // One plane, 24 bits a pixel; no compression, and the default of all else.
    out.extend([1, 0, 24, 0]);
    out.extend(
        [0, size, 0, 0, 0, 0]
            .iter()
            .flat_map(|word: &u32| word.to_le_bytes()),
    );
    let row = pixels.width * pixels.channels;
    for line in pixels.data.chunks_exact(row).step_by(step).take(height) {
        for pixel in line.chunks_exact(pixels.channels).step_by(step).take(width) {
            match *pixel {
                [grey] => out.extend([grey; 3]),
                [red, green, blue, ..] => out.extend([blue, green, red]),
                _ => return None,
            }
        }
        out.extend(&padding);
    }
    Some(out)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_array_becomes_a_bitmap_of_its_shape() {
        let data = [255, 0, 0, 0, 255, 0, 0, 0, 255, 9, 9, 9];
        let array = Pickle::array(DType::UINT8, &[2, 2, 3], &data).expect("an array");
        let (kind, bytes) = of(&Content::Value(array)).expect("a picture");
        assert_eq!((kind, bytes.len()), ("image/bmp", 54 + 2 * 8));
        assert_eq!(&bytes[54..60], [0, 0, 255, 0, 255, 0]);
        assert_eq!(&bytes[18..26], [2, 0, 0, 0, 254, 255, 255, 255]);
        let large =
            Pickle::array(DType::UINT8, &[1300, 900], &vec![7; 1_170_000]).expect("an array");
        let (_, bytes) = of(&Content::Value(large)).expect("a picture");
        assert_eq!(bytes.len(), 54 + 433 * 300 * 3);
        for shape in [&[4, 2, 2][..], &[16], &[16, 1]] {
            let other = Pickle::array(DType::UINT8, shape, &[0; 16]).expect("an array");
            assert!(!is_one(&Content::Value(other)), "{shape:?}");
        }
    }

    #[test]
    fn files_are_known_by_how_they_begin() {
        let jpeg = Pickle::bytes(&[0xff, 0xd8, 0xff, 0xe0]).expect("bytes");
        assert_eq!(
            of(&Content::Value(jpeg)).map(|(kind, _)| kind),
            Some("image/jpeg")
        );
        assert_eq!(
            of(&Content::Bytes(b"\x89PNG\r\n")).map(|(kind, _)| kind),
            Some("image/png")
        );
        assert!(!is_one(&Content::Bytes(b"<svg>")));
    }
}
