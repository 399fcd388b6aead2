/* The few calls of LinuxCNC's HAL that its component `pid` makes, in one process without threads.
 *
 * `pid.so` of the package linuxcnc-uspace is loaded and stepped by whoever calls `hal_calculate`, so
 * that a simulated machine and the controller keep the same time.
 */
#include <dlfcn.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

enum { PINS = 128, NAME = 64 };

static struct {
    char name[NAME];
    void *value;
} pins[PINS];
static int known;
static void (*calculate)(void *, long);
static void *channel;

void *hal_malloc(long bytes) { return calloc(1, (size_t)bytes); }

static int pin(void **at, const char *format, va_list arguments)
{
    if (known == PINS)
        return -1;
    vsnprintf(pins[known].name, NAME, format, arguments);
    *at = pins[known++].value = hal_malloc(8);
    return *at ? 0 : -1;
}

#define PIN(function)                                                                              \
    int function(int direction, void **at, int component, const char *format, ...)                \
    {                                                                                              \
        va_list arguments;                                                                         \
        (void)direction, (void)component;                                                          \
        va_start(arguments, format);                                                               \
        int refused = pin(at, format, arguments);                                                  \
        va_end(arguments);                                                                         \
        return refused;                                                                            \
    }
PIN(hal_pin_bit_newf)
PIN(hal_pin_float_newf)
PIN(hal_pin_s32_newf)
PIN(hal_pin_u32_newf)

int hal_init(const char *name) { return (void)name, 1; }
int hal_ready(int component) { return (void)component, 0; }
int hal_exit(int component) { return (void)component, 0; }

int hal_export_funct(const char *name, void (*function)(void *, long), void *argument, int uses_fp,
                     int reentrant, int component)
{
    (void)name, (void)uses_fp, (void)reentrant, (void)component;
    if (!calculate)
        calculate = function, channel = argument;
    return 0;
}

int rtapi_get_msg_level(void) { return 0; }
int rtapi_set_msg_level(int level) { return (void)level, 0; }
void rtapi_print_msg(int level, const char *format, ...) { (void)level, (void)format; }

int rtapi_snprintf(char *text, unsigned long size, const char *format, ...)
{
    va_list arguments;
    va_start(arguments, format);
    int length = vsnprintf(text, size, format, arguments);
    va_end(arguments);
    return length;
}

/* A fresh `pid.0`; 0 if the module is there and has started. */
int hal_load(const char *module)
{
    static void *loaded;
    if (!loaded && !(loaded = dlopen(module, RTLD_NOW | RTLD_GLOBAL)))
        return -1;
    int (*begin)(void);
    *(void **)&begin = dlsym(loaded, "rtapi_app_main");
    known = 0, calculate = NULL;
    return begin && begin() == 0 && calculate ? 0 : -1;
}

/* The place of a pin's value, or NULL. */
void *hal_pin(const char *name)
{
    for (int i = 0; i < known; i++)
        if (strcmp(pins[i].name, name) == 0)
            return pins[i].value;
    return NULL;
}

void hal_calculate(long nanoseconds) { calculate(channel, nanoseconds); }
