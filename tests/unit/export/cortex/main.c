/* The exported estimator over a recorded capture on a Cortex-M4F in QEMU: bits of values and standard deviations at
 * every tick, then sizes, stack and instructions a sample, by semihosting. */
#include <stdint.h>
#include <string.h>

#include "servo_estimator.h"
#include "capture.h" /* SAMPLES, TICK, noise, start, start_std, voltage, current, counts */

extern uint32_t stack_top, bss_begin, bss_end;
int main(void);

__attribute__((noreturn)) static void leave(void) {
    register uint32_t op __asm__("r0") = 0x18, code __asm__("r1") = 0x20026; /* SYS_EXIT, ADP_Stopped_ApplicationExit */
    __asm__ volatile("bkpt 0xab" : : "r"(op), "r"(code) : "memory");
    for (;;) {}
}

static void fault(void) {
    static const char text[] = "fault\n";
    register uint32_t op __asm__("r0") = 0x04;
    register const char *what __asm__("r1") = text;
    __asm__ volatile("bkpt 0xab" : : "r"(op), "r"(what) : "memory");
    leave();
}

void reset(void) {
    *(volatile uint32_t *)0xE000ED88 |= 0xFu << 20; /* CPACR: the FPU is on */
    __asm__ volatile("dsb\n isb");
    for (uint32_t *at = &bss_begin; at < &bss_end; at++) *at = 0;
    main();
    leave();
}

__attribute__((section(".vectors"), used)) static const void *const vectors[16] = {
    &stack_top, (void *)reset, (void *)fault, (void *)fault, (void *)fault, (void *)fault, (void *)fault};

static void put(const char *text) {
    register uint32_t op __asm__("r0") = 0x04; /* SYS_WRITE0 */
    register const char *what __asm__("r1") = text;
    __asm__ volatile("bkpt 0xab" : "+r"(op) : "r"(what) : "memory");
}

static void put_hex(uint32_t value, char end) {
    char text[10];
    for (int k = 0; k < 8; k++) text[k] = "0123456789abcdef"[(value >> (28 - 4 * k)) & 15];
    text[8] = end;
    text[9] = 0;
    put(text);
}

static void put_float(float value, char end) {
    uint32_t bits;
    memcpy(&bits, &value, sizeof bits);
    put_hex(bits, end);
}

#define STACK_LOOKED_AT 8192u
#define SYSTICK ((volatile uint32_t *)0xE000E010) /* control, reload, value */

static servo_estimator e;

int main(void) {
    uint32_t spent = 0, deepest = 0;
    volatile uint8_t *const top = (volatile uint8_t *)__builtin_frame_address(0) - 64;
    SYSTICK[1] = 0xFFFFFF;
    SYSTICK[2] = 0;
    SYSTICK[0] = 5; /* on, from the processor's clock */
    /* What a known number of instructions takes: 200,000 of them. */
    const uint32_t known = SYSTICK[2];
    __asm__ volatile("ldr r3, =100000\n 1: subs r3, #1\n bne 1b" : : : "r3", "cc");
    const uint32_t ticks = (known - SYSTICK[2]) & 0xFFFFFF;
    servo_estimator_start_at(&e, &noise, counts[0], start, start_std);
    for (uint32_t k = 0; k < SAMPLES; k++) {
        if (k == SAMPLES / 2)
            for (uint32_t j = 1; j < STACK_LOOKED_AT; j++) top[-(int32_t)j] = 0xA5;
        const uint32_t before = SYSTICK[2];
        servo_estimator_sample(&e, PERIOD, voltage[k], current[k], counts[k], SERVO_ALL_VALID);
        spent += (before - SYSTICK[2]) & 0xFFFFFF;
        if (k == SAMPLES / 2)
            for (uint32_t j = 1; j < STACK_LOOKED_AT; j++)
                if (top[-(int32_t)j] != 0xA5) deepest = j;
        if ((k + 1) % TICK == 0)
            for (int j = 0; j < SERVO_PARAMETERS; j++) {
                put_float(servo_estimator_value(&e, j), ' ');
                put_float(servo_estimator_std(&e, j), j + 1 < SERVO_PARAMETERS ? ' ' : '\n');
            }
    }
    put("sizes ");
    put_hex(sizeof e, ' ');
    put_hex(deepest, ' ');
    put_hex(spent, ' ');
    put_hex(ticks, ' ');
    put_hex(servo_estimator_status(&e), '\n');
    return 0;
}
