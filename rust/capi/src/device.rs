//! [`Device`] in storage of the caller.

use crate::{place, tell};
use core::ffi::{CStr, c_char, c_void};
use core::slice;
use sewfast_control::Refused;
use sewfast_control::link::identity::MAX_CHANNELS;
use sewfast_control::link::{
    Channel, Device, Encoding, Identity, Limits, Measurement, Output, Reason, Source, Travel,
};

/// Number of values of a profile that the device holds.
pub const CAPACITY: usize = 2048;

/// The device and the data its identity refers to; the storage must not move.
#[derive(Debug)]
pub struct Storage {
    device: Device<CAPACITY>,
    channels: [Channel; MAX_CHANNELS],
}

/// `sewfast_channel`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CChannel {
    /// `sewfast_encoding`.
    pub encoding: u8,
    /// `sewfast_source`.
    pub source: u8,
    /// The index in `further`, if that is the source.
    pub further: u8,
    /// Steps per unit.
    pub steps_per_unit: u32,
    /// UTF-8, closed by a zero.
    pub name: *const c_char,
    /// UTF-8, closed by a zero.
    pub unit: *const c_char,
}

/// `sewfast_limits`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CLimits {
    /// \[V\].
    pub volt: f32,
    /// \[RPM\].
    pub speed: f32,
    /// \[RPM/s\].
    pub acceleration: f32,
    /// \[A\].
    pub current: f32,
}

/// `sewfast_identity`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CIdentity {
    /// Must differ from that of the previous boot.
    pub boot_id: u32,
    /// Bits unknown to outsiders.
    pub entropy: u32,
    /// UTF-8, closed by a zero.
    pub name: *const c_char,
    /// UTF-8, closed by a zero.
    pub firmware: *const c_char,
    /// Control period \[us\].
    pub period: u32,
    /// Counts per turn.
    pub counts_per_rev: f32,
    /// Bits of the protocol.
    pub capabilities: u32,
    /// Upper bounds of the limits.
    pub ceilings: CLimits,
    /// Array of `channel_count` channels.
    pub channels: *const CChannel,
    /// 2 to 16.
    pub channel_count: usize,
    /// Least count of a run; both 0 for anywhere.
    pub travel_low: i32,
    /// Greatest count of a run.
    pub travel_high: i32,
}

/// `sewfast_measurement`.
#[repr(C)]
#[derive(Clone, Copy, Debug)]
pub struct CMeasurement {
    /// The counter.
    pub counts: i32,
    /// \[A\]; NaN if none is measured.
    pub current: f32,
    /// Array of `further_count` values.
    pub further: *const f32,
    /// May be 0.
    pub further_count: usize,
}

/// `sewfast_output`.
#[repr(C)]
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct COutput {
    /// \[V\].
    pub u: f32,
    /// Whether the drive may be switched on.
    pub enabled: bool,
}

impl From<Output> for COutput {
    fn from(Output { u, enabled }: Output) -> Self {
        Self { u, enabled }
    }
}

/// Why no device was made: `sewfast_refusal`.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(i32)]
enum Refusal {
    None = 0,
    Storage = 1,
    Text = 2,
    Name = 3,
    Firmware = 4,
    Period = 5,
    CountsPerRev = 6,
    Ceilings = 7,
    Channels = 8,
    Travel = 9,
}

impl From<Refused> for Refusal {
    fn from(refused: Refused) -> Self {
        match refused.name {
            "name" => Self::Name,
            "firmware" => Self::Firmware,
            "period" => Self::Period,
            "counts_per_rev" => Self::CountsPerRev,
            "travel" => Self::Travel,
            "volt" | "speed" | "acceleration" | "current" => Self::Ceilings,
            _ => Self::Channels,
        }
    }
}

/// # Safety
/// `text` is null or a text closed by a zero that stays unchanged as long as the device is used.
unsafe fn text(text: *const c_char) -> Result<&'static str, Refusal> {
    if text.is_null() {
        return Err(Refusal::Text);
    }
    // SAFETY: by contract, a text that outlives the device.
    let text = unsafe { CStr::from_ptr(text) };
    text.to_str().map_err(|_| Refusal::Text)
}

impl CChannel {
    /// # Safety
    /// As for [`text`].
    unsafe fn channel(&self) -> Result<Channel, Refusal> {
        let encoding = match self.encoding {
            0 => Encoding::Counts,
            1 => Encoding::Steps,
            2 => Encoding::Float,
            _ => return Err(Refusal::Channels),
        };
        let source = match self.source {
            0 => Source::Counts,
            1 => Source::Command,
            2 => Source::Current,
            3 => Source::Reference,
            4 => Source::Feedback,
            5 => Source::Further(self.further),
            _ => return Err(Refusal::Channels),
        };
        Ok(Channel {
            encoding,
            steps_per_unit: self.steps_per_unit,
            // SAFETY: by contract.
            name: unsafe { text(self.name)? },
            // SAFETY: by contract.
            unit: unsafe { text(self.unit)? },
            source,
        })
    }
}

/// # Safety
/// `storage` is writable; the texts and channels of `identity` are as documented in the header.
unsafe fn init(storage: *mut Storage, identity: &CIdentity) -> Result<(), Refusal> {
    let count = identity.channel_count;
    if identity.channels.is_null() || count > MAX_CHANNELS {
        return Err(Refusal::Channels);
    }
    // SAFETY: not null, and by contract that many.
    let given = unsafe { slice::from_raw_parts(identity.channels, count) };
    // SAFETY: a field of writable storage.
    let channels = unsafe { &raw mut (*storage).channels }.cast::<Channel>();
    for (index, channel) in given.iter().enumerate() {
        // SAFETY: by contract; below MAX_CHANNELS.
        unsafe { channels.add(index).write(channel.channel()?) };
    }
    let CLimits {
        volt,
        speed,
        acceleration,
        current,
    } = identity.ceilings;
    let identity = Identity {
        boot_id: identity.boot_id,
        entropy: identity.entropy,
        // SAFETY: by contract.
        name: unsafe { text(identity.name)? },
        // SAFETY: by contract.
        firmware: unsafe { text(identity.firmware)? },
        period: identity.period,
        counts_per_rev: identity.counts_per_rev,
        capabilities: identity.capabilities,
        ceilings: Limits {
            volt,
            speed,
            acceleration,
            current,
        },
        travel: match (identity.travel_low, identity.travel_high) {
            (0, 0) => Travel::ANY,
            (low, high) => Travel { low, high },
        },
        // SAFETY: written above and never again, and the caller does not move the storage.
        channels: unsafe { slice::from_raw_parts(channels, count) },
    };
    // SAFETY: a field of writable storage. It is written from a constant, because a microcontroller's stack has no room
    // for a device.
    let device = unsafe {
        let place = &raw mut (*storage).device;
        place.write(Device::off());
        &mut *place
    };
    Ok(device.boot(identity)?)
}

/// Size of a device in bytes.
#[unsafe(no_mangle)]
pub extern "C" fn sewfast_device_size() -> usize {
    size_of::<Storage>()
}

/// Alignment of a device.
#[unsafe(no_mangle)]
pub extern "C" fn sewfast_device_alignment() -> usize {
    align_of::<Storage>()
}

/// Makes a device at boot in `storage`; null if it is refused.
///
/// # Safety
/// `storage` is `size` bytes of memory that nothing else uses and that does not move; `identity` and its texts are as
/// documented in the header; `refusal` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_init(
    storage: *mut c_void,
    size: usize,
    identity: *const CIdentity,
    refusal: *mut i32,
) -> *mut Storage {
    let place = place::<Storage>(storage, size).filter(|_| !identity.is_null());
    let made = place.ok_or(Refusal::Storage).and_then(|place| {
        // SAFETY: place is fit for a Storage; identity is not null and by contract as documented in the header.
        unsafe { init(place, &*identity) }.map(|()| place)
    });
    let code = made.err().unwrap_or(Refusal::None);
    // SAFETY: by contract.
    unsafe { tell(refusal, code as i32) };
    made.unwrap_or(core::ptr::null_mut())
}

/// # Safety
/// `storage` is null or came from [`sewfast_device_init`], and nothing else uses the device during the call.
unsafe fn device<'a>(storage: *mut Storage) -> Option<&'a mut Device<CAPACITY>> {
    if storage.is_null() {
        return None;
    }
    // SAFETY: not null, so it was initialised; only the device is borrowed, as it refers to the channels.
    Some(unsafe { &mut (*storage).device })
}

/// # Safety
/// `bytes` is null, or `count` of them are readable.
unsafe fn read<'a, T>(bytes: *const T, count: usize) -> &'a [T] {
    if bytes.is_null() {
        return &[];
    }
    // SAFETY: by contract.
    unsafe { slice::from_raw_parts(bytes, count) }
}

/// [`Device::receive`].
///
/// # Safety
/// `device` came from [`sewfast_device_init`] and is used by one context at a time; `count` bytes are readable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_receive(
    device: *mut Storage,
    now: u64,
    bytes: *const u8,
    count: usize,
) {
    // SAFETY: by contract.
    if let Some(device) = unsafe { self::device(device) } {
        // SAFETY: by contract.
        device.receive(now, unsafe { read(bytes, count) });
    }
}

/// [`Device::sample`]; the safe output if there is no device.
///
/// # Safety
/// `device` as above; `measurement` is null or as documented in the header.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_sample(
    device: *mut Storage,
    now: u64,
    measurement: *const CMeasurement,
) -> COutput {
    // SAFETY: by contract.
    let (device, measurement) = unsafe { (self::device(device), measurement.as_ref()) };
    let output = device.map_or(Output::SAFE, |device| match measurement {
        Some(measurement) => {
            let CMeasurement {
                counts,
                current,
                further,
                further_count,
            } = *measurement;
            let measurement = Measurement {
                counts,
                current,
                // SAFETY: by contract.
                further: unsafe { read(further, further_count) },
            };
            device.sample(now, &measurement)
        }
        None => {
            device.trip(now, Reason::Measurement);
            device.poll(now)
        }
    });
    output.into()
}

/// [`Device::poll`]; the safe output if there is no device.
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_poll(device: *mut Storage, now: u64) -> COutput {
    // SAFETY: by contract.
    let device = unsafe { self::device(device) };
    device
        .map_or(Output::SAFE, |device| device.poll(now))
        .into()
}

/// [`Device::transmit`].
///
/// # Safety
/// `device` as above; `size` bytes of `out` are writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_transmit(
    device: *mut Storage,
    out: *mut u8,
    size: usize,
) -> usize {
    // SAFETY: by contract.
    let Some(device) = (unsafe { self::device(device) }) else {
        return 0;
    };
    if out.is_null() {
        return 0;
    }
    // SAFETY: not null, and by contract that long.
    device.transmit(unsafe { slice::from_raw_parts_mut(out, size) })
}

/// [`Device::trip`].
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_trip(device: *mut Storage, now: u64, reason: i32) {
    let reason = match reason {
        2 => Reason::Speed,
        3 => Reason::Acceleration,
        4 => Reason::Current,
        8 => Reason::Measurement,
        9 => Reason::NoMotion,
        11 => Reason::Late,
        12 => Reason::Swinging,
        13 => Reason::Travel,
        _ => Reason::StopInput,
    };
    // SAFETY: by contract.
    if let Some(device) = unsafe { self::device(device) } {
        device.trip(now, reason);
    }
}

/// [`Device::credit`]: whether there is one, and until when.
///
/// # Safety
/// `device` as above; `until` is null or writable.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_credit(device: *mut Storage, until: *mut u64) -> bool {
    // SAFETY: by contract.
    let credit = unsafe { self::device(device) }.and_then(|device| device.credit());
    if let (Some(credit), false) = (credit, until.is_null()) {
        // SAFETY: not null, and by contract.
        unsafe { until.write(credit) };
    }
    credit.is_some()
}

/// [`Device::armed_count`]; 0 if there is no device.
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_armed_count(device: *mut Storage) -> u32 {
    // SAFETY: by contract.
    let device = unsafe { self::device(device) };
    device.map_or(0, |device| device.armed_count())
}

/// [`Device::disconnect`].
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_disconnect(device: *mut Storage) {
    // SAFETY: by contract.
    if let Some(device) = unsafe { self::device(device) } {
        device.disconnect();
    }
}

/// [`Device::state`]; boot if there is no device.
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_state(device: *mut Storage) -> i32 {
    // SAFETY: by contract.
    let device = unsafe { self::device(device) };
    device.map_or(0, |device| device.state() as i32)
}

/// [`Device::reason`].
///
/// # Safety
/// `device` as above.
#[unsafe(no_mangle)]
pub unsafe extern "C" fn sewfast_device_reason(device: *mut Storage) -> i32 {
    // SAFETY: by contract.
    let device = unsafe { self::device(device) };
    device.map_or(0, |device| device.reason() as i32)
}
