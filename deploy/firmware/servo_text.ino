// The text wire of servo-daemon on an Arduino: t_us,mV,mA,counts (docs/protocol.md). Encoder on pins 2 and 3.
volatile long counts = 0;
void tick() { counts += digitalRead(2) == digitalRead(3) ? -1 : 1; }  // counts_per_rev = 2 x lines: both edges of A
void setup() { Serial.begin(500000); attachInterrupt(digitalPinToInterrupt(2), tick, CHANGE); }
void loop() {
  static unsigned long next = micros();
  while ((long)(micros() - next) < 0) {}  // every 2 ms
  next += 2000;
  noInterrupts(); long c = counts; interrupts();
  long mV = analogRead(A0) * 24000L / 1023, mA = (analogRead(A1) - 512L) * 4883 / 100;  // 24 V divider, ACS712-20A
  char line[48];
  sprintf(line, "%lu,%ld,%ld,%ld\n", micros(), mV, mA, c);
  Serial.print(line);
}
