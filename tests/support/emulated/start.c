/* From reset to main on the emulated board: floating-point unit on, memory filled, results by semihosting. */
#include <stdint.h>
#include <string.h>

extern uint32_t __stack, __data, __data_end, __data_load, __bss_start__, __bss_end__;
int main(void);
static int call(int operation, const void *argument)
{
    register int r0 __asm__("r0") = operation;
    register const void *r1 __asm__("r1") = argument;
    __asm__ volatile("bkpt 0xab" : "+r"(r0) : "r"(r1) : "memory");
    return r0;
}

/* What main prints through. */
void say(const char *text)
{
    call(4, text);
}

void Reset_Handler(void)
{
    static const uint32_t done[2] = {0x20026, 0}, failed[2] = {0x20026, 1};
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* coprocessors 10 and 11 */
    __asm__ volatile("dsb; isb");
    memcpy(&__data, &__data_load, (size_t)((char *)&__data_end - (char *)&__data));
    memset(&__bss_start__, 0, (size_t)((char *)&__bss_end__ - (char *)&__bss_start__));
    call(0x20, main() ? failed : done);
    for (;;) {
    }
}

static void Fault_Handler(void)
{
    static const uint32_t failed[2] = {0x20026, 2};
    say("fault\n");
    call(0x20, failed);
    for (;;) {
    }
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &__stack, (void *)Reset_Handler, (void *)Fault_Handler, (void *)Fault_Handler, (void *)Fault_Handler,
    (void *)Fault_Handler, (void *)Fault_Handler,
};
