/* Just enough of an Arduino for servo_text.ino on a computer: time passes 100 us a look, the converters count up. */
#include <stdio.h>

enum { A0, A1, CHANGE };
static unsigned long now_us = 1000;
static int reading = 500;

static unsigned long micros() { return now_us += 100; }
static int analogRead(int) { return ++reading; }
static int digitalRead(int) { return 0; }
static int digitalPinToInterrupt(int pin) { return pin; }
static void (*interrupt)();
static void attachInterrupt(int, void (*handler)(), int) { interrupt = handler; }
static void noInterrupts() {}
static void interrupts() {}

struct {
    void begin(long) {}
    void print(const char *text) { fputs(text, stdout); }
} Serial;

void setup();
void loop();

int main() {
    setup();
    for (int k = 0; k < 5; k++) {
        interrupt();
        loop();
    }
}
