//! Threads as interrupts: `critical-section`'s implementation for `std`.

use super::*;
use crate::log::LogSource;
use std::thread;
use std::vec::Vec;
use ztl_core::link::{ADDR_ONLY_NODE, Body, Decoder, Frame, encode};

fn ping(seq: u8) -> Vec<u8> {
    let mut buffer = [0xA5; 32];
    let frame = Frame {
        addr: ADDR_ONLY_NODE,
        seq,
        body: Body::Ping,
    };
    let len = encode(5, &frame, &mut buffer).unwrap();
    buffer[..len].to_vec()
}

/// The seqs of the good frames that are in the queue.
fn drain<const N: usize>(queue: &ReceiveQueue<N>, decoder: &mut Decoder<32>, seen: &mut Vec<u8>) {
    let mut buffer = [0xA5; 7];
    loop {
        let count = queue.take(&mut buffer);
        for byte in &buffer[..count] {
            if decoder.push(*byte) == Ok(true)
                && let Ok((_, frame)) = decoder.frame(&[5])
            {
                seen.push(frame.seq);
            }
        }
        if count == 0 {
            return;
        }
    }
}

#[test]
fn an_overflow_is_counted_and_later_bytes_are_read() {
    // Wherever the overflow begins and ends, what is lost are whole frames.
    for room in 0..30usize {
        let queue = ReceiveQueue::<32>::new();
        let mut decoder = Decoder::new();
        let mut seen = Vec::new();
        for byte in std::iter::repeat_n(0, room).chain((1..=5).flat_map(ping)) {
            queue.push(byte);
        }
        drain(&queue, &mut decoder, &mut seen);
        let good = seen.len();
        assert_eq!(seen, (1..=good as u8).collect::<Vec<_>>());
        assert!(good < 5);
        assert!(queue.lost() > 0);
        // The frame under way is lost too, up to its delimiter.
        for byte in (6..=8).flat_map(ping) {
            queue.push(byte);
        }
        drain(&queue, &mut decoder, &mut seen);
        assert!(seen.ends_with(&[7, 8]), "{room}: {seen:?}");
    }
}

#[test]
fn after_a_gap_bytes_are_dropped_until_a_delimiter() {
    let queue = ReceiveQueue::<4>::new();
    let mut buffer = [0xA5; 8];
    (1..=6).for_each(|byte| queue.push(byte));
    assert_eq!(queue.take(&mut buffer), 4);
    for byte in [7, 8, 0, 9] {
        queue.push(byte);
    }
    assert_eq!(queue.take(&mut buffer), 2);
    assert_eq!(buffer[..2], [0, 9]);
    assert_eq!(queue.lost(), 4);
}

#[test]
fn an_interrupt_fills_the_queue_while_the_main_loop_empties_it() {
    static QUEUE: ReceiveQueue<64> = ReceiveQueue::new();
    let interrupt = thread::spawn(|| {
        for turn in 0..2000u32 {
            for byte in ping((turn % 255) as u8 + 1) {
                QUEUE.push(byte);
            }
            if turn % 8 == 0 {
                thread::yield_now();
            }
        }
    });
    let mut decoder = Decoder::new();
    let mut seen = Vec::new();
    while !interrupt.is_finished() {
        drain(&QUEUE, &mut decoder, &mut seen);
        thread::yield_now();
    }
    interrupt.join().unwrap();
    drain(&QUEUE, &mut decoder, &mut seen);
    // Each byte that was lost is a frame that was lost, at most.
    let lost = QUEUE.lost() as usize;
    assert!(seen.len() + lost >= 2000, "{} and {lost}", seen.len());
    assert!(seen.len() <= 2000);
}

#[test]
fn the_queue_is_a_reader_that_waits_for_its_interrupt() {
    static QUEUE: ReceiveQueue<8> = ReceiveQueue::new();
    let mut reader = &QUEUE;
    assert_eq!(reader.read_ready(), Ok(false));
    let interrupt = thread::spawn(|| QUEUE.push(7));
    let mut buffer = [0xA5; 4];
    assert_eq!(reader.read(&mut buffer), Ok(1));
    assert_eq!(buffer[0], 7);
    assert_eq!(reader.read(&mut []), Ok(0));
    interrupt.join().unwrap();
}

#[test]
fn slices_are_pushed_like_bytes() {
    for len in [0, 1, 15, 16, 17, 40, 64, 70] {
        let (slices, bytes) = (ReceiveQueue::<64>::new(), ReceiveQueue::<64>::new());
        let all: Vec<u8> = (1..=len).chain([0]).collect();
        slices.push_slice(&all);
        all.iter().for_each(|byte| bytes.push(*byte));
        let [from_slices, from_bytes] = [&slices, &bytes].map(|queue| {
            let mut buffer = [0xA5; 80];
            let count = queue.take(&mut buffer);
            (buffer[..count].to_vec(), queue.lost())
        });
        assert_eq!(from_slices, from_bytes);
    }
}

#[test]
fn a_circular_dma_is_followed_round_its_ring() {
    use core::sync::atomic::{AtomicU8, Ordering};

    let ring = [const { AtomicU8::new(0) }; 8];
    let queue = ReceiveQueue::<64>::new();
    let (mut written, mut taken) = (0, 0);
    let mut expected = Vec::new();
    // The DMA interrupts at 4 and 0, the line falls idle anywhere.
    for at in [3, 3, 4, 0, 1, 4, 7, 0, 4, 0, 2, 4, 0, 0] {
        while written % 8 != at {
            let byte = written as u8 + 1;
            ring[written % 8].store(byte, Ordering::Relaxed);
            expected.push(byte);
            written += 1;
        }
        queue.push_ring(&ring, &mut taken, at);
    }
    let mut buffer = [0xA5; 64];
    let count = queue.take(&mut buffer);
    assert_eq!(buffer[..count], expected);
    // A register that says more than there is.
    queue.push_ring(&ring, &mut taken, 9);
    assert_eq!(queue.take(&mut buffer), 0);
}

#[cfg(feature = "async")]
#[test]
fn an_async_reader_sleeps_until_the_interrupt_wakes_it() {
    use core::future::Future as _;
    use core::pin::pin;
    use std::sync::Arc;
    use std::sync::atomic::{AtomicU32, Ordering};

    #[derive(Default)]
    struct Bell(AtomicU32);

    impl std::task::Wake for Bell {
        fn wake(self: Arc<Self>) {
            self.0.fetch_add(1, Ordering::Relaxed);
        }
    }

    let queue = ReceiveQueue::<8>::new();
    let bell = Arc::new(Bell::default());
    let rings = || bell.0.swap(0, Ordering::Relaxed);
    let waker = Waker::from(bell.clone());
    let mut context = Context::from_waker(&waker);
    let mut reader = &queue;
    let mut buffer = [0xA5; 4];
    {
        let mut reading = pin!(embedded_io_async::Read::read(&mut reader, &mut buffer));
        assert!(reading.as_mut().poll(&mut context).is_pending());
        assert_eq!(rings(), 0);
        queue.push_slice(&[7, 8]);
        queue.push(9);
        assert_eq!(rings(), 1, "once for all");
        assert_eq!(reading.as_mut().poll(&mut context), Poll::Ready(Ok(3)));
    }
    assert_eq!(buffer[..3], [7, 8, 9]);
    let reading = pin!(embedded_io_async::Read::read(&mut reader, &mut []));
    assert_eq!(reading.poll(&mut context), Poll::Ready(Ok(0)));
}

#[test]
fn a_flag_stays_raised_until_it_is_taken_once() {
    static STOP: StopFlag = StopFlag::new();
    static END: EndFlag = EndFlag::new();
    assert!(!STOP.take());
    let interrupt = thread::spawn(|| {
        STOP.raise();
        STOP.raise();
        END.report();
    });
    interrupt.join().unwrap();
    assert!(STOP.is_raised() && END.is_reached());
    assert!(STOP.take() && END.take());
    assert!(!STOP.take() && !END.take());
}

#[test]
fn records_of_several_interrupts_do_not_mix() {
    static LOG: LogQueue<200> = LogQueue::new();
    let interrupts = [b'a', b'b', b'c'].map(|name| {
        thread::spawn(move || {
            let kept = (0..500)
                .filter(|_| LOG.push(&[name, name, name, 0]))
                .count();
            (name, kept)
        })
    });
    let mut all = Vec::new();
    let mut read = || {
        let mut buffer = [0xA5; 30];
        let count = LOG.read(&mut buffer);
        all.extend_from_slice(&buffer[..count]);
        count
    };
    while interrupts.iter().any(|interrupt| !interrupt.is_finished()) {
        read();
    }
    while read() > 0 {}
    let mut kept = 0;
    for interrupt in interrupts {
        let (name, count) = interrupt.join().unwrap();
        kept += count;
        let records = all
            .chunks(4)
            .filter(|record| *record == [name, name, name, 0]);
        assert_eq!(records.count(), count);
    }
    assert_eq!(all.len(), kept * 4);
    assert_eq!(LOG.lost() as usize, (1500 - kept) * 4);
}
