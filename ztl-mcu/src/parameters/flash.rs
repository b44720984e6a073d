//! Values saved in a NOR flash by `sequential-storage`, which spreads the wear and withstands power cuts. Requires the feature
//! `flash`.

use core::fmt;
use core::future::Future;
use core::ops::Range;
use core::pin::pin;
use core::task::{Context, Poll, Waker};

use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};
use sequential_storage::Error;
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::map::{MapConfig, MapStorage};

use super::tuned::{LONGEST_VALUE, SaveError, Storage};

/// Room for a key and a value, rounded up to the longest word of a flash.
const ROOM: usize = (8 + LONGEST_VALUE).next_multiple_of(32);

/// Aligned, as some flash controllers demand.
#[repr(align(4))]
struct Buffer([u8; ROOM]);

/// Saves values in a part of a NOR flash. Pages that hold something else, such as an earlier program, are erased when values
/// are saved.
///
/// The pages but one must have room for all values, at most 72 bytes each. Pages that are full with values are erased, too, and
/// what fits is saved again.
///
/// A value takes some 30 bytes, and each change another 30. When a page is full, another one is erased, which takes the
/// processor 20 ms to 100 ms on many chips, and seconds on those with pages of 128 KiB. The node saves only while no task
/// runs; choose a [link timeout](crate::Identity::link_timeout) that is longer than an erase.
pub struct Flash<F: NorFlash> {
    map: Map<F>,
}

type Map<F> = MapStorage<u64, Blocking<F>, Cache<Uncached, Uncached, Uncached, u64>>;

impl<F: NorFlash> Flash<F> {
    /// Saves values between these addresses of a flash, which must be the borders of pages; at least two pages, so that one
    /// can be erased. `None` if they are not.
    pub fn new(flash: F, addresses: Range<u32>) -> Option<Self> {
        let config = MapConfig::try_new(addresses).ok()?;
        let map = MapStorage::new(Blocking(flash), config, Cache::new_uncached());
        Some(Self { map })
    }

    /// Writes a value and reads it again. Returns `false` if the pages hold something else than values.
    fn store(&mut self, key: u64, bytes: &[u8]) -> Result<bool, SaveError> {
        let mut room = Buffer([0; ROOM]);
        match at_once(self.map.store_item(&mut room.0, &key, &bytes))? {
            Ok(()) => {
                let stored = at_once(self.map.fetch_item::<&[u8]>(&mut room.0, &key))?;
                Ok(matches!(stored, Ok(Some(stored)) if stored == bytes))
            }
            Err(Error::Storage { .. }) => Err(SaveError::Failed),
            Err(_) => Ok(false),
        }
    }
}

impl<F: NorFlash> Storage for Flash<F> {
    fn read(&mut self, key: u64, buffer: &mut [u8]) -> Result<Option<usize>, SaveError> {
        let mut room = Buffer([0; ROOM]);
        let found = at_once(self.map.fetch_item::<&[u8]>(&mut room.0, &key))?;
        let Some(value) = found.map_err(|_| SaveError::Failed)? else {
            return Ok(None);
        };
        let to = buffer.get_mut(..value.len()).ok_or(SaveError::Failed)?;
        to.copy_from_slice(value);
        Ok(Some(value.len()))
    }

    fn write(&mut self, key: u64, bytes: &[u8]) -> Result<(), SaveError> {
        if self.store(key, bytes)? {
            return Ok(());
        }
        at_once(self.map.erase_all())?.map_err(|_| SaveError::Failed)?;
        if self.store(key, bytes)? {
            return Ok(());
        }
        Err(SaveError::Failed)
    }
}

impl<F: NorFlash> fmt::Debug for Flash<F> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("Flash")
    }
}

/// The result of a future that never waits, since all of its operations block.
fn at_once<T>(future: impl Future<Output = T>) -> Result<T, SaveError> {
    match pin!(future).poll(&mut Context::from_waker(Waker::noop())) {
        Poll::Ready(result) => Ok(result),
        Poll::Pending => Err(SaveError::Failed),
    }
}

/// A blocking flash behind the async traits.
struct Blocking<F>(F);

impl<F: ErrorType> ErrorType for Blocking<F> {
    type Error = F::Error;
}

impl<F: ReadNorFlash> embedded_storage_async::nor_flash::ReadNorFlash for Blocking<F> {
    const READ_SIZE: usize = F::READ_SIZE;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Self::Error> {
        self.0.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl<F: NorFlash> embedded_storage_async::nor_flash::NorFlash for Blocking<F> {
    const WRITE_SIZE: usize = F::WRITE_SIZE;
    const ERASE_SIZE: usize = F::ERASE_SIZE;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Self::Error> {
        self.0.erase(from, to)
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Self::Error> {
        self.0.write(offset, bytes)
    }
}

#[cfg(test)]
mod tests;
